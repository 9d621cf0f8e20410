# Tables and figures, from the logs alone.


def all_logs(wildcards):
    s = BY_NAME[wildcards.scenario]
    names = [
        *(name for group in GROUPS for name in paths.evaluation_logs(s, group)),
        *(
            name
            for axis in SWEPT_KEYS
            for group in GROUPS
            for name in paths.sweep_logs(s, axis, group)
        ),
        *paths.gain_study_logs(s),
        *paths.training_logs(s),
    ]
    return inside(s, names)


rule aggregate:
    input:
        logs=all_logs,
        scenario=ancient(f"results/{{scenario}}/{paths.SCENARIO}"),
    output:
        csv=[
            report(
                ensure(f"results/{{scenario}}/tables/{name}.csv", non_empty=True),
                caption="../report/table.rst",
                category="{scenario}",
                subcategory="Tables",
                labels={"table": name},
            )
            for name in paths.TABLES
        ],
        markdown=[
            ensure(f"results/{{scenario}}/tables/{name}.md", non_empty=True)
            for name in paths.TABLES
        ],
    log:
        "results/{scenario}/logs/aggregate.log",
    benchmark:
        "results/{scenario}/benchmarks/aggregate.tsv"
    threads: 1
    params:
        spec=lambda w: spec.stage_spec(
            "aggregate", spec.scenario_values(BY_NAME[w.scenario], NOTES), script("aggregate")
        ),
    shell:
        "{sys.executable} workflow/scripts/aggregate.py --scenario {input.scenario}"
        " --results results/{wildcards.scenario} > {log} 2>&1"


rule figures:
    input:
        logs=all_logs,
        scenario=ancient(f"results/{{scenario}}/{paths.SCENARIO}"),
    output:
        svg=[
            report(
                ensure(f"results/{{scenario}}/figures/{name}.svg", non_empty=True),
                caption=f"../report/{name}.rst",
                category="{scenario}",
                subcategory="Figures",
                labels={"figure": name},
            )
            for name in paths.FIGURES
        ],
        png=[
            ensure(f"results/{{scenario}}/figures/{name}.png", non_empty=True)
            for name in paths.FIGURES
        ],
    log:
        "results/{scenario}/logs/figures.log",
    benchmark:
        "results/{scenario}/benchmarks/figures.tsv"
    threads: 1
    params:
        spec=lambda w: spec.stage_spec(
            "figures", spec.scenario_values(BY_NAME[w.scenario]), script("figures")
        ),
    shell:
        "{sys.executable} workflow/scripts/figures.py --scenario {input.scenario}"
        " --results results/{wildcards.scenario} > {log} 2>&1"
