"""Torch with one thread, as in a job: its sums depend on the number of threads."""

import rsavatar  # noqa: F401 - first: sets how OpenMP waits, before torch loads it

import torch  # isort: skip

torch.set_num_threads(1)
