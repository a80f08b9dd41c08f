"""Fields along paths in float64: image method, diffraction (UTD), Doppler shifts and delays (`geometry`),
atmosphere, antenna patterns."""
