"""Options that several groups of commands take."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter

#: Numbers with commas between, the first of which may be negative: --at -0.5,.8,.3.
type Numbers = Annotated[str | None, Parameter(allow_leading_hyphen=True)]
