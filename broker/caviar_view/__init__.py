"""The viewer: a page that shows a run in 3D, and the answers that it asks for.

`answers` makes every answer, for the process that serves HTTP and for pages that are saved; `world` is what
stands still, `frames` where frames come from. ``page/`` is built of ``clients/view``.
"""
