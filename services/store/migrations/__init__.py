"""The database's versions: one file per step in ``versions``, applied by ``services.store.schema``."""
