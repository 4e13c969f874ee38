"""Takes archives of subjects apart, in a process of its own with little to spend: ``python -m services.unpack``."""
