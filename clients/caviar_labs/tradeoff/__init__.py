"""Time and error of channel settings over the same scenes."""
