"""A study as one HTML page: verdicts, figures, tables that sort, where everything comes from."""

from hiersched.study.page.build import write_study_page

__all__ = ["write_study_page"]
