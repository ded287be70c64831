"""The report page of homing runs: one HTML file, drawn as those of SLAM are."""

from fgslam.report.homing.data import HomingPage, TextTable
from fgslam.report.homing.page import write_homing_report
from fgslam.report.page.data import Column, Picture

__all__ = ["Column", "HomingPage", "Picture", "TextTable", "write_homing_report"]
