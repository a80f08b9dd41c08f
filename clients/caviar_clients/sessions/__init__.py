"""A run as an agent outside of it drives it, from grant to grant: in this process or at a broker."""
