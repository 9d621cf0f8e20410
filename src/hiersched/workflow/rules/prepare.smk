# The resolved scenario, the gains, the compiled slot loop.
# Shell commands are formatted when a job runs, long after the loops: what differs from rule to rule is in `args`. They
# see no name of these files where the workflow is a module of another one, so scripts run as modules of the package.


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
        "{sys.executable:q} -P -m hiersched.workflow.scripts.kernels --output {output} > {log} 2>&1"


for s in SCENARIOS:

    rule:
        name:
            f"resolve_{s.name}"
        output:
            whole(s, [files.SCENARIO]),
        log:
            f"{folder(s)}/logs/resolve.log",
        priority: 100  # tables that are older than it are those of other values
        threads: 1
        params:
            spec=spec("resolve", dependencies.scenario_values(s)),
            args=arguments("resolve", s),
        message:
            f"Writing the resolved scenario {s.name}"
        shell:
            "{sys.executable:q} -P -m hiersched.workflow.scripts.{params.args} > {log} 2>&1"

    for design in designs(s):

        rule:
            name:
                f"gains_{design}_{s.name}"
            output:
                whole(s, [files.gain_file(design)]),
            log:
                f"{folder(s)}/logs/gains_{design}.log",
            benchmark:
                benchmark_file(s, f"gains_{design}")
            threads: 1
            params:
                spec=spec("gains", dependencies.gains_values(s, design)),
                args=arguments("gains", s, "--design", design),
            message:
                f"Designing gains of {s.name}: {design}"
            shell:
                "{sys.executable:q} -P -m hiersched.workflow.scripts.{params.args} > {log} 2>&1"

    if "gain_grid" in experiments(s):

        rule:
            name:
                f"stability_{s.name}"
            input:
                gain_files(s, experiment_designs(s, experiments(s)["gain_grid"])),
            output:
                whole(s, [files.STABILITY]),
            log:
                f"{folder(s)}/logs/stability.log",
            benchmark:
                benchmark_file(s, "stability")
            threads: 1
            params:
                spec=spec("stability", dependencies.stability_values(s)),
                args=arguments("stability", s),
            message:
                f"Finding the longest delays: {s.name}"
            shell:
                "{sys.executable:q} -P -m hiersched.workflow.scripts.{params.args} > {log} 2>&1"
