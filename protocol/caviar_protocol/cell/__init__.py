"""Kernels of a radio cell in NumPy: buffers of packets, traffic, scheduling, rates.

The link ``cell`` is made of them, and environments that step many cells at once use the same functions. They
know neither frames nor services: arrays of buffers in, arrays of buffers out, with any number of them.
"""
