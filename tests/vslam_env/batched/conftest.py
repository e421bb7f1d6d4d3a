"""Tests of batched teams are collected in a process of their own: jax has threads, and other tests fork."""

import os

OWN_PROCESS = "VSLAM_TESTS_WITH_JAX"  # set in that process

collect_ignore_glob = [] if OWN_PROCESS in os.environ else ["test_batched_*.py"]
