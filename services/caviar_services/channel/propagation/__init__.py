"""Propagation in float64: image method, Fresnel coefficients, diffraction (UTD), atmosphere, foliage, people
as screens, antenna patterns."""
