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
        spec=lambda w: dependencies.stage_spec(
            "resolve", dependencies.scenario_values(BY_NAME[w.scenario]), script("resolve")
        ),
        args=lambda w: arguments("resolve", BY_NAME[w.scenario]),
    message:
        "Writing the resolved scenario {wildcards.scenario}"
    shell:
        "{sys.executable:q} {SCRIPTS:q}/{params.args} > {log} 2>&1"


rule gains:
    output:
        ensure("results/{scenario}/gains/{design}.json", non_empty=True),
    log:
        "results/{scenario}/logs/gains_{design}.log",
    benchmark:
        "results/{scenario}/benchmarks/gains_{design}.tsv"
    threads: 1
    params:
        spec=lambda w: dependencies.stage_spec(
            "gains", dependencies.gains_values(BY_NAME[w.scenario], w.design), script("gains")
        ),
        args=lambda w: arguments("gains", BY_NAME[w.scenario], "--design", w.design),
    message:
        "Designing gains: {wildcards.scenario}, {wildcards.design}"
    shell:
        "{sys.executable:q} {SCRIPTS:q}/{params.args} > {log} 2>&1"


rule stability:
    input:
        lambda w: inside(BY_NAME[w.scenario], paths.stability_gain_files(BY_NAME[w.scenario])),
    output:
        ensure(f"results/{{scenario}}/{paths.STABILITY}", non_empty=True),
    log:
        "results/{scenario}/logs/stability.log",
    benchmark:
        "results/{scenario}/benchmarks/stability.tsv"
    threads: 1
    params:
        spec=lambda w: dependencies.stage_spec(
            "stability", dependencies.stability_values(BY_NAME[w.scenario]), script("stability")
        ),
        args=lambda w: arguments("stability", BY_NAME[w.scenario]),
    message:
        "Finding the longest delays: {wildcards.scenario}"
    shell:
        "{sys.executable:q} {SCRIPTS:q}/{params.args} > {log} 2>&1"


# Compiling the slot loop takes longer than most jobs run: once, for all of them. The file is named after the code,
# so new code is compiled anew; whatever needs the loop has to run then in any case.
rule kernels:
    output:
        ensure(KERNELS, non_empty=True),
    log:
        f"{KERNELS}.log",
    benchmark:
        f"{KERNELS}.tsv"
    priority: 100
    threads: 1
    message:
        "Compiling the slot loop"
    shell:
        "{sys.executable:q} {SCRIPTS:q}/kernels.py --output {output} > {log} 2>&1"
