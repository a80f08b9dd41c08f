"""Fields along paths in float64: image method, diffraction (UTD), atmosphere, antenna patterns."""
