from ._bode import bode as bode
from ._comparison import comparison as comparison
from ._histories import histories as histories
from ._json import write_json as write_json
from ._overlay import overlay as overlay, record_figure as record_figure
from ._results import write_results as write_results
