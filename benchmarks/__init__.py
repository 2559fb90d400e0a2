"""Speed and accuracy as ratios against a stated peer, measured in the same run: `python -m benchmarks [NAME ...]`."""
