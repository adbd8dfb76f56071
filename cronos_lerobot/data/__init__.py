"""Datasets: the schema, a fast LeRobotDataset writer, recorded training streams, demonstrations."""
