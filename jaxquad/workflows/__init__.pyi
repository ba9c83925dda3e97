from ._autopilot import autopilot as autopilot, recipe as recipe
from ._autopilot_settings import (
    AutopilotSettings as AutopilotSettings,
    CompareSettings as CompareSettings,
    limits_of as limits_of,
)
from ._batch import batch as batch, find_logs as find_logs
from ._batch_workers import Job as Job
from ._compare import compare as compare
from ._identification import Identification as Identification
from ._identify import (
    identify as identify,
    identify_again as identify_again,
    identify_opened as identify_opened,
    verify_result as verify_result,
)
from ._log import (
    DEMO as DEMO,
    DEMO_TRUTH as DEMO_TRUTH,
    find_demo_flight as find_demo_flight,
    open_logs as open_logs,
    OpenedLogs as OpenedLogs,
    propose_settings as propose_settings,
    write_demo_log as write_demo_log,
)
from ._look import AxisView as AxisView, LogView as LogView, look as look
from ._options import Settings as Settings, SettingsError as SettingsError
from ._result_file import (
    default_folder as default_folder,
    free_folder as free_folder,
    load_result as load_result,
    load_tuning as load_tuning,
    StoredResult as StoredResult,
    StoredTuning as StoredTuning,
)
from ._settings import (
    BatchSettings as BatchSettings,
    GROUPS as GROUPS,
    IdentifySettings as IdentifySettings,
    in_options as in_options,
    Override as Override,
    TuneSettings as TuneSettings,
)
from ._tune import tune as tune, Tuning as Tuning
