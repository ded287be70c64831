"""The report page of homing runs: one HTML file, drawn as those of SLAM are."""

from fgslam.export.homing_report.data import HomingPage, TextTable
from fgslam.export.homing_report.page import write_homing_report
from fgslam.export.report.data import Column, Picture

__all__ = ["Column", "HomingPage", "Picture", "TextTable", "write_homing_report"]
