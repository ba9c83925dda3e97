from ._attitude import (
    Attitude as Attitude,
    DecoupledAxes as DecoupledAxes,
    euler_acceleration as euler_acceleration,
    euler_from_quaternion as euler_from_quaternion,
    euler_rates as euler_rates,
    euler_rates_matrix as euler_rates_matrix,
    LinearAxis as LinearAxis,
    quaternion_derivative as quaternion_derivative,
    quaternion_from_euler as quaternion_from_euler,
)
from ._convert import (
    feedthrough as feedthrough,
    from_control as from_control,
    realise as realise,
    state_space as state_space,
)
from ._declared import declares as declares, parameter_units as parameter_units
from ._discrete import (
    DiscreteTransferFunction as DiscreteTransferFunction,
    require_sampled as require_sampled,
)
from ._multirotor import (
    Allocation as Allocation,
    CRAZYFLIE as CRAZYFLIE,
    crazyflie as crazyflie,
    MotorLag as MotorLag,
    Multirotor as Multirotor,
    MultirotorState as MultirotorState,
    QUANSER_HOVER as QUANSER_HOVER,
    quanser_hover as quanser_hover,
)
from ._response import arctan2 as arctan2, sincos as sincos
from ._simulate_linear import (
    free_responses as free_responses,
    matrix_exponential as matrix_exponential,
    sample_rational as sample_rational,
    sample_states as sample_states,
    SampledRational as SampledRational,
    SampledStates as SampledStates,
    simulate_linear as simulate_linear,
    split_delay as split_delay,
)
from ._state_space import (
    explicit as explicit,
    Mode as Mode,
    modes as modes,
    StateSpace as StateSpace,
)
from ._transfer_function import (
    AttitudeAxis as AttitudeAxis,
    Convertible as Convertible,
    evaluate_response as evaluate_response,
    imaginary as imaginary,
    LaggedIntegrator as LaggedIntegrator,
    Model as Model,
    TransferFunction as TransferFunction,
    with_arrays as with_arrays,
)
