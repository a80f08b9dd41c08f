"""What a frame costs in the broker: a run of clients that do nothing but exchange products."""
