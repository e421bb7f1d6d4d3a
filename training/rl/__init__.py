"""Reinforcement learning: trainer, network, checkpoints, workers and evaluation."""
