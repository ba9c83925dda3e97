"""What to fly where a log cannot tell, in the words of each firmware."""

from ._parameters import Firmware


_NUMBERS = {"roll": 0, "pitch": 1, "yaw": 2}


def what_to_fly(firmware: Firmware, axis: str) -> str:
    """A flight that excites the axis: what to set, what to fly, how to end it."""
    if firmware == "betaflight":
        return (
            "Fly this: set debug_mode = CHIRP, blackbox at 1 kHz or more, and CHIRP on a switch "
            f"(firmware 2025.12 or later; each use takes the next axis, so until {axis}); hover "
            "high and clear, hold the switch for 20 s, release it to end. Without CHIRP: strong "
            f"and quick {axis} stick in acro for 20 s"
        )
    if firmware == "ardupilot":
        rate = 7 + _NUMBERS[axis]
        return (
            f"Fly this: SID_AXIS {rate + 3} (mixer, {axis}; or {rate}, rate), SID_F_START_HZ 0.5, "
            "SID_F_STOP_HZ 20, SID_T_REC 30, LOG_BITMASK with fast attitude and PIDs; hover high "
            "and clear in Loiter, switch to mode SystemID for 30 s, back to end. Begin with a "
            "small SID_MAGNITUDE and raise it until the vehicle is seen to shake"
        )
    return (
        "Fly this: SDLOG_PROFILE with high rate, hover high and clear in Position mode, and strong "
        f"and quick {axis} stick in Acro for 20 s, or the autotune (MC_AT_EN) on this axis"
    )
