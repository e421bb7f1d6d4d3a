"""Compilation of kernels: disk cache, parallel workers, messages, and the wheel of compiled kernels."""
