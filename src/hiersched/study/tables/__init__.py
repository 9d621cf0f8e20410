"""Tables of a study."""

from hiersched.core.extras import naming_extras

with naming_extras():
    import pandas as pandas
