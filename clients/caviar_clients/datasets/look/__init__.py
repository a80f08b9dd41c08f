"""The page of a dataset, ``caviar dataset look``: one HTML file that opens without a network.

`page` puts it together of sections, and `description` says what the dataset is; `maps`, `distributions` and
`scans` draw on `pictures`; `data` is what they draw, `html` the markup around it.
"""
