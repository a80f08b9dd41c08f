"""The frame clock and its rules: events and the time go in, actions come out.

Nothing here opens a socket, starts a thread or reads a clock, so that real time, as-fast-as-possible,
embedded runs, replays and the tests in virtual time are all thin shells around one core.
"""
