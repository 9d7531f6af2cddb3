"""Reports of a run: one HTML page that opens offline, with figures and their data in folders."""

from __future__ import annotations

from fmuid.report.diagnosis_figures import DiagnosisPictures
from fmuid.report.diagnosis_page import write_diagnosis_report
from fmuid.report.identification_page import write_report

__all__ = ["DiagnosisPictures", "write_diagnosis_report", "write_report"]
