"""Benchmarks, streams, policies and results as repositories on the Hugging Face Hub."""
