"""The report page of a run: one self-contained HTML file."""

from fgslam.export.report.data import Column, Comparison, EstimatorReport, Picture, ReportData
from fgslam.export.report.page import write_report

__all__ = ["Column", "Comparison", "EstimatorReport", "Picture", "ReportData", "write_report"]
