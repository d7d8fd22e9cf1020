"""One thread per process, as the stages do it: two threads with a busy neighbour are ten times slower."""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import torch

torch.set_num_threads(1)
