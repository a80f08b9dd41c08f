"""Links: what the communication system achieves with the beams that were chosen."""
