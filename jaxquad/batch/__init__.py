from ._identify_log import identify_log as identify_log
from ._plan import planned as planned
from ._run import run_batch as run_batch
from ._settings import read_settings as read_settings, Settings as Settings
from ._store import Job as Job
