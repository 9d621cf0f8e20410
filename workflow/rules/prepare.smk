# The resolved scenario, the gains, the compiled slot loop.


localrules:
    resolve,


rule resolve:
    output:
        ensure(f"results/{{scenario}}/{paths.SCENARIO}", non_empty=True),
    log:
        "results/{scenario}/logs/resolve.log",
    benchmark:
        "results/{scenario}/benchmarks/resolve.tsv"
    threads: 1
    params:
        source=lambda w: SOURCE_OF[w.scenario],
        spec=lambda w: spec.stage_spec(
            "resolve", spec.scenario_values(BY_NAME[w.scenario]), script("resolve")
        ),
    shell:
        "{sys.executable} workflow/scripts/resolve.py --scenario {params.source:q}"
        " --output {output} > {log} 2>&1"


rule gains:
    input:
        scenario=ancient(f"results/{{scenario}}/{paths.SCENARIO}"),
    output:
        ensure("results/{scenario}/gains/{design}.json", non_empty=True),
    log:
        "results/{scenario}/logs/gains_{design}.log",
    benchmark:
        "results/{scenario}/benchmarks/gains_{design}.tsv"
    threads: 1
    params:
        spec=lambda w: spec.stage_spec(
            "gains", spec.gains_values(BY_NAME[w.scenario], w.design), script("gains")
        ),
    shell:
        "{sys.executable} workflow/scripts/gains.py --scenario {input.scenario}"
        " --design {wildcards.design} --output {output} > {log} 2>&1"


# Compiling the slot loop takes longer than most jobs run: once, for all of them. The file is named after the code,
# so new code is compiled anew; that alone is no reason for a job to run, its own `spec` says whether it is.
rule kernels:
    output:
        ensure(KERNELS, non_empty=True),
    log:
        f"{KERNELS}.log",
    benchmark:
        f"{KERNELS}.tsv"
    priority: 100
    threads: 1
    params:
        spec=KERNELS_SPEC,
    shell:
        "{sys.executable} workflow/scripts/kernels.py --output {output} > {log} 2>&1"
