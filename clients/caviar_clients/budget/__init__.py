"""What frame rate a recorded run would sustain."""
