from ._comparison import (
    AxisComparison as AxisComparison,
    ChangedSetting as ChangedSetting,
    compare_axes as compare_axes,
    ComparedQuantity as ComparedQuantity,
    FlightComparison as FlightComparison,
)
from ._filter_bank import filter_choices as filter_choices
from ._filters import (
    ardupilot_notch as ardupilot_notch,
    BandwidthNotch as BandwidthNotch,
    betaflight_quality as betaflight_quality,
    Butterworth as Butterworth,
    Filter as Filter,
    FilterChain as FilterChain,
    FilterShare as FilterShare,
    Notch as Notch,
    PT1 as PT1,
    PT2 as PT2,
    PT3 as PT3,
    Section as Section,
)
from ._firmware import (
    Channels as Channels,
    FilterChoice as FilterChoice,
    FilterOption as FilterOption,
    Firmware as Firmware,
    firmware_named as firmware_named,
    HOVER as HOVER,
    LowPass as LowPass,
    Numbers as Numbers,
    OuterLoop as OuterLoop,
    Parameter as Parameter,
    Recipe as Recipe,
    RecipeOption as RecipeOption,
    RecipeSteps as RecipeSteps,
    register as register,
    rows_of_axes as rows_of_axes,
)
from ._flight_channels import (
    best_filters as best_filters,
    FlightChannels as FlightChannels,
    FlownAutopilot as FlownAutopilot,
    read_channels_if_any as read_channels_if_any,
    read_flown as read_flown,
    settings_of as settings_of,
)
from ._flight_qualities import (
    Estimate as Estimate,
    FlownAxis as FlownAxis,
    measured_step as measured_step,
)
from ._gains import (
    Cascade as Cascade,
    cascade_of as cascade_of,
    cascade_parameters as cascade_parameters,
    find_inexpressible as find_inexpressible,
    ladrc_as_pid as ladrc_as_pid,
    LADRCAsPID as LADRCAsPID,
    motor_share as motor_share,
    pid_of as pid_of,
    rate_gains as rate_gains,
    rate_parameters as rate_parameters,
    RateGains as RateGains,
    torque_per_unit as torque_per_unit,
)
from ._identified_log import (
    flown_law as flown_law,
    FlownLaw as FlownLaw,
    loop_of_law as loop_of_law,
    StoredFilters as StoredFilters,
    study_throttle as study_throttle,
)
from ._law import (
    AngleLoop as AngleLoop,
    FirmwareLoop as FirmwareLoop,
    FlownLoop as FlownLoop,
    LoopState as LoopState,
    RateLoop as RateLoop,
)
from ._law_check import check_law as check_law, check_loop as check_loop
from ._page import (
    B0Section as B0Section,
    PilotPage as PilotPage,
    proposed_steps as proposed_steps,
    write_pilot_page as write_pilot_page,
)
from ._parameters import (
    change_table as change_table,
    check_ranges as check_ranges,
    find_parameter as find_parameter,
    flown_loop as flown_loop,
    list_parameters as list_parameters,
    parameter_file as parameter_file,
    ParameterChange as ParameterChange,
    ParameterFiles as ParameterFiles,
    PARAMETERS as PARAMETERS,
    propose_changes as propose_changes,
    store_parameters as store_parameters,
    with_parameters as with_parameters,
    WordChange as WordChange,
    write_parameter_files as write_parameter_files,
)
from ._proposal import (
    AutopilotProposal as AutopilotProposal,
    AxesProposal as AxesProposal,
)
from ._rate_design import design_gains as design_gains
from ._rate_loops import (
    certify_angle as certify_angle,
    delay_margin as delay_margin,
    hold_plants as hold_plants,
    RateLoops as RateLoops,
)
from ._replay import (
    hold_response as hold_response,
    predict_loop as predict_loop,
    replay_terms as replay_terms,
    reproduce_flight as reproduce_flight,
    Reproduction as Reproduction,
)
from ._verdict import judge as judge
from .firmwares._ardupilot import (
    ardupilot_harmonic_notch as ardupilot_harmonic_notch,
    ardupilot_loop as ardupilot_loop,
    ArduPilotAttitude as ArduPilotAttitude,
    ArduPilotRate as ArduPilotRate,
    FlownArduPilot as FlownArduPilot,
    HarmonicNotch as HarmonicNotch,
)
from .firmwares._betaflight import (
    betaflight_loop as betaflight_loop,
    flies_adrc as flies_adrc,
    FlownBetaflight as FlownBetaflight,
)
from .firmwares._betaflight_adrc import (
    adrc_parameters as adrc_parameters,
    ADRCProposal as ADRCProposal,
    ADRCStage as ADRCStage,
    ADRCTargets as ADRCTargets,
    b0_law as b0_law,
    betaflight_adrc_loop as betaflight_adrc_loop,
    Flown as Flown,
    FlownADRC as FlownADRC,
)
from .firmwares._betaflight_adrc_result import (
    ADRCAutopilot as ADRCAutopilot,
    doubted_throttle as doubted_throttle,
    propose_adrc as propose_adrc,
)
from .firmwares._betaflight_law import (
    adrc_b0 as adrc_b0,
    BetaflightADRC as BetaflightADRC,
    BetaflightAngle as BetaflightAngle,
    BetaflightPID as BetaflightPID,
    DMax as DMax,
    dynamic_cutoff as dynamic_cutoff,
    ItermRelax as ItermRelax,
    tpa_factor as tpa_factor,
)
from .firmwares._betaflight_log import (
    CHIRP_TRUTH as CHIRP_TRUTH,
    write_chirp_log as write_chirp_log,
)
from .firmwares._crazyflie import (
    CrazyflieAttitude as CrazyflieAttitude,
    CrazyflieRate as CrazyflieRate,
)
from .firmwares._px4 import px4_loop as px4_loop, PX4Attitude as PX4Attitude, PX4Rate as PX4Rate
