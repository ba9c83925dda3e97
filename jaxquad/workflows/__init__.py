from ._batch._identify_log import identify_log as identify_log
from ._batch._run import planned as planned, run_batch as run_batch
from ._batch._settings import read_settings as read_settings, Settings as Settings
from ._batch._store import Job as Job, write_whole as write_whole
from ._identify import identified as identified, report_identification as report_identification
from ._stored import stored as stored, stored_model as stored_model
from ._tune import (
    Case as Case,
    tuned_case as tuned_case,
    tuned_content as tuned_content,
    write_tuning as write_tuning,
)
