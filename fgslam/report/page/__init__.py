"""The report page of a run: one self-contained HTML file."""

from fgslam.report.page.data import Column, Comparison, EstimatorReport, Picture, ReportData
from fgslam.report.page.page import write_report

__all__ = ["Column", "Comparison", "EstimatorReport", "Picture", "ReportData", "write_report"]
