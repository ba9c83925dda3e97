import equinox as eqx
from jaxtyping import Array, Float


class LinearController(eqx.Module):
    """One axis of a controller without limits: x[k+1] = A x + Br r + By y, u = C x + Dr r + Dy y.

    r is the angle of the set-point, y the measurement of the same sample, in rad; u the command
    that is held until the next one. By and Dy carry the sign of the feedback.
    """

    A: Float[Array, "states states"]
    reference_in: Float[Array, " states"]  # Br
    measurement_in: Float[Array, " states"]  # By
    C: Float[Array, " states"]
    reference_through: Float[Array, ""]  # Dr
    measurement_through: Float[Array, ""]  # Dy
    dt: float = eqx.field(static=True)  # s
