"""The sampled loop against an adaptive solver that stops at every change of the inputs."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.control import LADRC
from jaxquad.loops import Loop
from jaxquad.models import Allocation, Attitude, MotorLag, Multirotor, QUANSER_HOVER
from jaxquad.simulation import MotorDrive, Scenario, simulate


DT, SAMPLES, DELAY = 0.002, 5000, 0.0053
SHEET = QUANSER_HOVER
ALLOCATION = Allocation(SHEET.arm, SHEET.thrust_coefficient, SHEET.torque_coefficient)
GAIN = np.array([SHEET.arm * SHEET.thrust_coefficient] * 2 + [SHEET.torque_coefficient])
PLANT = Multirotor(
    Attitude(SHEET.inertia, damping=(0.01,) * 3, stiffness=(0.05, 0.04, 0.0)),
    ALLOCATION,
    MotorLag(0.02),
)
DRIVE = MotorDrive(ALLOCATION, limit=4.0)
LAW = LADRC([4.0, 4.0, 2.0], [40.0, 40.0, 20.0], 1.8 * GAIN / np.array(SHEET.inertia), dt=DT)


def manoeuvre() -> Scenario:
    """Large steps on all axes, one after the other, under steady and swinging torques."""
    time = DT * np.arange(SAMPLES)
    steps = [size * ((time // wait) % 2) for size, wait in ((0.35, 2.5), (0.2, 3.5), (0.05, 5.0))]
    torque = [0.02 * np.sin(2 * time), 0.01 + 0 * time, 0.001 * np.sin(time)]
    still = jnp.zeros((SAMPLES, 3))
    return Scenario(jnp.asarray(np.stack(steps, 1)), still, jnp.asarray(np.stack(torque, 1)), still)


def adaptive(case: Scenario, delay: float) -> np.ndarray:
    """Every held piece integrated on its own by an eighth-order method that controls its error."""
    slope = dfx.ODETerm(lambda t, x, held: PLANT.derivative(x, *held))
    control = dfx.PIDController(rtol=1e-12, atol=1e-14)
    whole, broken = int(delay // DT), delay % DT

    def piece(state, inputs, torque, span):
        held, at_end = (inputs, torque), dfx.SaveAt(t1=True)
        done = dfx.diffeqsolve(
            slope, dfx.Dopri8(), 0.0, span, span, state, held,
            stepsize_controller=control, saveat=at_end, adjoint=dfx.DirectAdjoint(),
        )  # fmt: skip
        return jax.tree.map(lambda x: x[0], done.ys)

    def sample(carry, now):
        state, memory, past = carry
        reference, torque = now
        angle = PLANT.measure(state)
        memory, command = LAW.step(memory, reference, angle)
        inputs = DRIVE.inputs(command)
        memory = LAW.applied(memory, DRIVE.achieved(inputs))
        past = [*past, inputs]
        state = piece(state, past[-2 - whole], torque, broken)
        state = piece(state, past[-1 - whole], torque, DT - broken)
        return (state, memory, past[1:]), angle

    idle = DRIVE.inputs(jnp.zeros(3))
    start = (PLANT.init(), LAW.init(jnp.zeros(3)), [idle] * (whole + 1))
    run = jax.jit(lambda given: jax.lax.scan(sample, start, given)[1])
    return np.asarray(run((case.reference, case.disturbance)))


@pytest.fixture(scope="module")
def exact():
    return adaptive(manoeuvre(), DELAY)


@pytest.mark.slow
def test_ten_seconds_of_the_rig_with_lag_delay_and_saturation_agree_to_1e_8(exact):
    found = simulate(Loop(PLANT, LAW, dt=DT, drive=DRIVE, delay=DELAY), manoeuvre())
    assert 0.05 < np.mean(found.saturated) < 0.5 and np.ptp(found.angle) > 0.35
    # One Runge-Kutta step a piece: (dt / lag)^4 / 120 of what the motors lag behind.
    np.testing.assert_allclose(found.angle, exact, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_substeps_take_the_rest_of_the_error_away(exact):
    errors = []
    for substeps in (1, 2):
        run = simulate(
            Loop(PLANT, LAW, dt=DT, drive=DRIVE, delay=DELAY, substeps=substeps), manoeuvre()
        )
        errors.append(np.max(np.abs(np.asarray(run.angle) - exact)))
    # The order is four; rounding and the reference's own tolerance are 1e-13.
    assert 10 < errors[0] / errors[1] < 25
