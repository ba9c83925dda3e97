from ._loop import LawLoop as LawLoop
from ._numbers import compare_fits as compare_fits
from ._page import (
    Cell as Cell,
    embed_figure as embed_figure,
    Headline as Headline,
    render_page as render_page,
    Section as Section,
    Table as Table,
)
from ._report import write_report as write_report
from ._results import (
    attempt as attempt,
    FAILED as FAILED,
    PageWarning as PageWarning,
    Provenance as Provenance,
    provenance as provenance,
    provenance_section as provenance_section,
    reason_of as reason_of,
    sha256_of as sha256_of,
    Source as Source,
    verification_content as verification_content,
    write_json as write_json,
    write_results as write_results,
)
