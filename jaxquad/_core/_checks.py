import numpy as np


Number = float | int


def check_positive(**values: Number) -> None:
    """Raise ValueError for the first of the named values that is not a positive number."""
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} is {value}: it has to be positive and finite.")


def check_not_negative(**values: Number) -> None:
    """Raise ValueError for the first of the named values that is negative or not finite."""
    for name, value in values.items():
        if not (np.isfinite(value) and value >= 0):
            raise ValueError(f"{name} is {value}: it has to be zero or positive, and finite.")


def check_band(omega_min: Number, omega_max: Number, sample_rate: Number) -> None:
    """Raise ValueError unless 0 < omega_min < omega_max < Nyquist (rad/s, Hz)."""
    check_positive(omega_min=omega_min, omega_max=omega_max, sample_rate=sample_rate)
    if omega_max <= omega_min:
        raise ValueError(
            f"omega_max {omega_max:.6g} rad/s is not above omega_min {omega_min:.6g} rad/s."
        )
    nyquist = np.pi * sample_rate
    if omega_max >= nyquist:
        raise ValueError(
            f"omega_max {omega_max:.6g} rad/s is not below {nyquist:.6g} rad/s, half the "
            f"sample_rate of {sample_rate:.6g} Hz: sample faster (25 times omega_max is the rule)."
        )


def whole_samples(name: str, seconds: Number, sample_rate: Number, *, fewest: int = 1) -> int:
    """The number of samples in `seconds`. Raises ValueError unless that is a whole number."""
    count = seconds * sample_rate
    if not np.isfinite(count):
        raise ValueError(f"{name} is {seconds} s at {sample_rate} Hz: it has to be finite.")
    whole = round(count)
    if whole < fewest or abs(count - whole) > 1e-6:
        below = max(fewest, int(np.floor(count)))
        raise ValueError(
            f"{name} of {seconds:.9g} s is {count:.6g} samples at {sample_rate:.6g} Hz, not "
            f"a whole number of at least {fewest}: the nearest are {below / sample_rate:.9g} s and "
            f"{(below + 1) / sample_rate:.9g} s."
        )
    return whole
