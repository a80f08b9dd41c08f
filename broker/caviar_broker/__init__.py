"""The clock broker: coordinates the services of a run and enforces frame deadlines."""
