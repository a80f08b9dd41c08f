"""Ray tracing with Sionna RT, Mitsuba and Dr.Jit: scene, launches, candidates, and the path solver."""
