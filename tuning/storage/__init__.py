"""Checkpoints: evaluation logs, finished batches, the lock on a folder."""
