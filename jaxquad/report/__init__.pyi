from ._attempt import (
    attempt as attempt,
    FAILED as FAILED,
    PageWarning as PageWarning,
    reason_of as reason_of,
)
from ._figure import embed_figure as embed_figure, Section as Section
from ._fit import compare_fits as compare_fits
from ._loop import LawLoop as LawLoop
from ._page import (
    Cell as Cell,
    Headline as Headline,
    render_page as render_page,
    Table as Table,
)
from ._provenance import (
    Provenance as Provenance,
    provenance as provenance,
    provenance_section as provenance_section,
    sha256_of as sha256_of,
    Source as Source,
)
from ._report import write_report as write_report
from ._results import (
    verification_content as verification_content,
    write_json as write_json,
    write_results as write_results,
)
