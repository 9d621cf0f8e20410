"""Registers the tables, figures and claims of this package."""

import hiersched.study.claims.judged
import hiersched.study.figures.comparison
import hiersched.study.figures.gains
import hiersched.study.figures.rates
import hiersched.study.figures.training
import hiersched.study.tables.gains
import hiersched.study.tables.paper
import hiersched.study.tables.policies  # noqa: F401
