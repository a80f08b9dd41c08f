"""The page of a dataset, ``caviar dataset look``: one HTML file that opens without a network.

`data` reads what is shown, `figures` and `maps` draw it, and `page` fills the template ``page.html``.
"""
