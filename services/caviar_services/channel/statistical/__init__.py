"""Channel models without a ray tracer: free space, and multipath drawn from stated distributions."""
