"""The service around the core: API, worker, store. Runs from the checkout."""
