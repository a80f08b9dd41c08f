"""Recorders: what writes a run down.

`mcap` is the service that a run grants frames; `segment_writer` begins, ends and synchronizes the files of
its recording; `mcap_file` packs and compresses the bytes of one.
"""
