"""Run folders and recordings on disk."""
