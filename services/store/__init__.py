"""The database: the only SQL and the only commits of the service."""
