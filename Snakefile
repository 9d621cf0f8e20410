# `snakemake --cores 2` in a clone: the workflow is part of the package.
include: "src/hiersched/workflow/Snakefile"


workflow.default_target = "all"  # `include` does not take it over
