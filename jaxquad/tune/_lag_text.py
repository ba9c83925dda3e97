"""Whether a loop is too fast for the lag of its motors."""

from typing import Any

import numpy as np


# No b0 stabilises a LADRC beyond this lag times wc, by wo / wc: docs/control.md.
_RATIOS, _ENDS = (3.0, 5.0, 10.0), (0.48, 0.44, 0.42)


def lag_remark(controller: Any, delay: Any, lag: Any) -> str | None:
    """lag times wc of a LADRC beside where no b0 helps any more; None for other controllers."""
    ladrc = getattr(controller, "ladrc", controller)
    if lag is None or not (hasattr(ladrc, "wc") and hasattr(ladrc, "wo")):
        return None
    wc, wo = float(np.max(np.asarray(ladrc.wc))), float(np.max(np.asarray(ladrc.wo)))
    longest, late = float(np.max(np.asarray(lag))), float(np.max(np.asarray(delay)))
    end = float(np.interp(np.log(wo / wc), np.log(_RATIOS), _ENDS))
    text = f"lag x wc is up to {1e3 * longest:.3g} ms x {wc:.3g} rad/s = {longest * wc:.2g}"
    if late:
        text += f", {(longest + late) * wc:.2g} with the delay of {1e3 * late:.3g} ms"
    if longest * wc >= end:
        return (
            f"{text}: too large, no b0 stabilises LADRC beyond about {end:.2g} at wo/wc = "
            f"{wo / wc:.3g}; wc below {end / longest:.3g} rad/s is necessary"
        )
    return (
        f"{text}; no b0 stabilises LADRC beyond about {end:.2g} at wo/wc = {wo / wc:.3g}, and Ms "
        "and margins are lost long before: a smaller wc buys them"
    )
