"""The channel at its extremes: cases whose right answer a formula gives, and what the models answer.

`caviar stability` runs them. A case builds a small world, asks a model, and compares with numbers from
`formulas`, which shares no code with the models. ``cases`` says which there are, by group.
"""
