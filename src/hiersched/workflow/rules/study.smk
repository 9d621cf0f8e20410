# Measures of every run, from its log or as its job took them; tables and figures, from measures, logs and stability regions.

for s in SCENARIOS:
    for group in groups_that_run(s):

        rule:
            name:
                f"measure_{group}_{s.name}"
            input:
                kernels=KERNELS,
                runs=inside(s, paths.measured_files(s, group)),
            output:
                ensure(f"{folder(s)}/{paths.measures_file(group)}", non_empty=True),
            log:
                f"{folder(s)}/logs/measure_{group}.log",
            benchmark:
                f"{folder(s)}/benchmarks/measure_{group}.tsv"
            threads: 1
            params:
                spec=dependencies.stage_spec(
                    f"measure_{group}", dependencies.measure_values(s, group), script("measure")
                ),
                args=arguments("measure", s, "--group", group),
            message:
                f"Measuring the runs of {s.name}: {group}"
            shell:
                "{sys.executable:q} {SCRIPTS:q}/{params.args} > {log} 2>&1"


rule aggregate:
    input:
        measures=lambda w: inside(BY_NAME[w.scenario], paths.measures_files(BY_NAME[w.scenario])),
        logs=lambda w: inside(BY_NAME[w.scenario], paths.all_logs(BY_NAME[w.scenario])),
        bound=f"results/{{scenario}}/{paths.BOUND}",
        stability=f"results/{{scenario}}/{paths.STABILITY}",
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
        runs=ensure(f"results/{{scenario}}/{paths.RUNS}", non_empty=True),
    log:
        "results/{scenario}/logs/aggregate.log",
    benchmark:
        "results/{scenario}/benchmarks/aggregate.tsv"
    threads: 1
    params:
        spec=lambda w: dependencies.stage_spec(
            "aggregate",
            dependencies.scenario_values(BY_NAME[w.scenario], NOTES),
            script("aggregate"),
        ),
        args=lambda w: arguments("aggregate", BY_NAME[w.scenario]),
    message:
        "Writing the tables of {wildcards.scenario}"
    shell:
        "{sys.executable:q} {SCRIPTS:q}/{params.args} > {log} 2>&1"


rule figures:
    input:
        measures=lambda w: inside(BY_NAME[w.scenario], paths.measures_files(BY_NAME[w.scenario])),
        logs=lambda w: inside(BY_NAME[w.scenario], paths.all_logs(BY_NAME[w.scenario])),
        bound=f"results/{{scenario}}/{paths.BOUND}",
        stability=f"results/{{scenario}}/{paths.STABILITY}",
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
        spec=lambda w: dependencies.stage_spec(
            "figures", dependencies.scenario_values(BY_NAME[w.scenario]), script("figures")
        ),
        args=lambda w: arguments("figures", BY_NAME[w.scenario]),
    message:
        "Drawing the figures of {wildcards.scenario}"
    shell:
        "{sys.executable:q} {SCRIPTS:q}/{params.args} > {log} 2>&1"


rule claims:
    input:
        measures=lambda w: inside(BY_NAME[w.scenario], paths.measures_files(BY_NAME[w.scenario])),
        logs=lambda w: inside(BY_NAME[w.scenario], paths.claim_logs(BY_NAME[w.scenario])),
    output:
        [
            report(
                ensure(f"results/{{scenario}}/{name}", non_empty=True),
                caption="../report/claims.rst",
                category="{scenario}",
                subcategory="Claims",
                labels={"claims": name},
            )
            for name in paths.CLAIMS
        ],
    log:
        "results/{scenario}/logs/claims.log",
    benchmark:
        "results/{scenario}/benchmarks/claims.tsv"
    threads: 1
    params:
        spec=lambda w: dependencies.stage_spec(
            "claims", dependencies.scenario_values(BY_NAME[w.scenario]), script("claims")
        ),
        args=lambda w: arguments("claims", BY_NAME[w.scenario]),
    message:
        "Judging the paper's claims in {wildcards.scenario}"
    shell:
        "{sys.executable:q} {SCRIPTS:q}/{params.args} > {log} 2>&1"
