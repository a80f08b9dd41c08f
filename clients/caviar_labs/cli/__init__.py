"""Commands of the laboratories. `caviar -h` imports these modules: heavy imports stand in functions."""
