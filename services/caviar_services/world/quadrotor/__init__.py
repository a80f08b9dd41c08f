"""Flight dynamics of a quadrotor: rigid body, rotors, wind, controller, contacts."""
