"""The scenarios that ship with CAVIAR: TOML files, and the data that they name, beside this file."""
