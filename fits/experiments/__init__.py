"""What `fits/suite.py` runs: it interprets `scenarios.toml` and matches the designs."""
