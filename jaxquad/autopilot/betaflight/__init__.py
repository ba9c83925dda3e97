"""Betaflight: `_log` says what its channels mean, `_law` and `_firmware` what it flies."""
