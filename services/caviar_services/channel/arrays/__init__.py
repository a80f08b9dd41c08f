"""Antenna arrays: channel matrices by plane waves, by exact path lengths, and by tracing each pair."""
