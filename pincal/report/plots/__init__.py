"""Figures of results, drawn on canvases of their own: nothing is shown, no state of matplotlib is
touched.

Each function takes a result and returns a :class:`matplotlib.figure.Figure`; save it with
``figure.savefig``. Those of a calibration take :class:`~pincal.report.subject.RowErrors`:

    evidence = pincal.report.subject.evidence_of(run)[0]
    pincal.report.plots.row_figures.cumulative_figure(evidence).savefig("errors.png")
"""

from pincal.errors import needed

with needed("matplotlib", "figures and reports"):
    import matplotlib  # noqa: F401
