"""The channel at its extremes: cases whose right answer a formula gives, and what the models answer.

`caviar measure stability` runs them. A case builds a small world (`lab`), asks a model, and compares with
numbers of `formulas`, which shares no code with the models. ``case.cases`` lists them by group.
"""
