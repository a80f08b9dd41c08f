"""The paper's experiments: ``caviar paper``. A module for each, and `comparison` for what they report."""
