"""The worker: claims jobs, watches the processes that train them, sweeps up after workers that died."""
