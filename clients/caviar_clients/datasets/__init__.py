"""Datasets (OUTLOOP): episodes that are farmed out, each a recording, with a catalogue and a reader.

``caviar dataset generate`` plays episodes, each as one embedded run in one process (`episode`), on the
processes of a Dask cluster (`cluster`). A folder of a dataset (`directory`) has a recording for each episode,
and a SQLite catalogue of what there is (`catalogue`), which says what is still to be done as well: generation
(`generate`) goes on where it was interrupted. `caviar.dataset` opens such a folder (`reader`).
"""
