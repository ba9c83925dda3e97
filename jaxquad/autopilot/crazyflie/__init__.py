"""The Crazyflie: `_log` says what its channels mean, `_firmware` what it flies."""
