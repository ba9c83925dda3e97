"""What `fits/paper.py` runs: one file for each part of the paper, and the ledger."""
