"""Candidate paths at moving bodies, enumerated face by face: no launch of rays meets each small face."""
