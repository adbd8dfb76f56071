"""What is asked: configurations, orderings, benchmarks as files, Gymnasium ids."""
