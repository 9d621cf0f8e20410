# The study, from scenarios to figures. `rule all` is here; the stages are in workflow/rules.
#
#   snakemake --cores 2                                the paper's scenario
#   snakemake --cores 2 --config scenarios='[smoke]'   others: files of config/scenarios, or paths
#   snakemake --cores 2 --report report.html           figures and tables in one file

from snakemake.utils import min_version

min_version("9.0")


report: "workflow/report/workflow.rst"


include: "workflow/rules/common.smk"


rule all:
    default_target: True
    input:
        [f"{folder(s)}/{paths.SCENARIO}" for s in SCENARIOS],
        [name for s in SCENARIOS for name in inside(s, paths.all_logs(s))],
        [f"{folder(s)}/{name}" for s in SCENARIOS for name in paths.CLAIMS],
        [f"{folder(s)}/figures/{name}.svg" for s in SCENARIOS for name in paths.FIGURES],
        [f"{folder(s)}/tables/{name}.csv" for s in SCENARIOS for name in paths.TABLES],
    message:
        "All figures and tables are there"


include: "workflow/rules/prepare.smk"
include: "workflow/rules/train.smk"
include: "workflow/rules/run.smk"
include: "workflow/rules/study.smk"


onsuccess:
    for s in SCENARIOS:
        print(f"{s.name}: figures in {folder(s)}/figures, tables in {folder(s)}/tables")


onerror:
    print("A job failed: its log is named above. Another run goes on from what is complete.")
