from ._autopilot._adrc import (
    ADRCProposal as ADRCProposal,
    propose_adrc as propose_adrc,
)
from ._autopilot._adrc_result import ADRCAutopilot as ADRCAutopilot
from ._autopilot._adrc_stages import ADRCStage as ADRCStage, ADRCTargets as ADRCTargets
from ._autopilot._axes_proposal import AxesProposal as AxesProposal
from ._autopilot._proposal import AutopilotProposal as AutopilotProposal
from ._autopilot._run import autopilot as autopilot
from ._batch._jobs import Job as Job
from ._batch._run import batch as batch, find_logs as find_logs
from ._batch._settings import BatchSettings as BatchSettings, Override as Override
from ._command_line import in_options as in_options
from ._demo import (
    DEMO as DEMO,
    DEMO_TRUTH as DEMO_TRUTH,
    find_demo_flight as find_demo_flight,
    write_demo_log as write_demo_log,
)
from ._demo_chirp import (
    CHIRP_TRUTH as CHIRP_TRUTH,
    write_chirp_log as write_chirp_log,
)
from ._identify import (
    Identification as Identification,
    identify as identify,
    identify_fit as identify_fit,
    identify_opened as identify_opened,
)
from ._kinds import SettingsError as SettingsError
from ._log import (
    open_again as open_again,
    open_logs as open_logs,
    OpenedLogs as OpenedLogs,
    propose_settings as propose_settings,
)
from ._result_file import (
    default_folder as default_folder,
    free_folder as free_folder,
    load_result as load_result,
    load_tuning as load_tuning,
    StoredResult as StoredResult,
    StoredTuning as StoredTuning,
)
from ._second_process import (
    import_estimates as import_estimates,
    import_figures as import_figures,
    second_process as second_process,
)
from ._settings import (
    GROUPS as GROUPS,
    IdentifySettings as IdentifySettings,
)
from ._stored import (
    identify_again as identify_again,
    verify_result as verify_result,
)
from ._tune import tune as tune, Tuning as Tuning
from ._tune_settings import (
    AutopilotSettings as AutopilotSettings,
    TuneSettings as TuneSettings,
)
