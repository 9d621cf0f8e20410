# Every policy in every world: one job a group of policies (and axis), since imports cost more than short runs.
# Shell commands are formatted when a job runs, long after the loops: what differs from rule to rule is in `args`.

for s in SCENARIOS:
    for group in groups_of(s, s.evaluate.policies):
        name, more = runner("evaluate", group)

        rule:
            name:
                f"evaluate_{group}_{s.name}"
            input:
                kernels=KERNELS,
                gains=f"{folder(s)}/{paths.gain_file('schedule')}",
                policies=weights(s, group),
            output:
                whole(inside(s, paths.evaluation_outputs(s, group))),
            log:
                f"{folder(s)}/logs/evaluate_{group}.log",
            benchmark:
                f"{folder(s)}/benchmarks/evaluate_{group}.tsv"
            threads: 1
            params:
                spec=dependencies.stage_spec(
                    f"evaluate_{group}",
                    dependencies.evaluate_values(s, group),
                    script(name),
                ),
                args=arguments(name, s, *more),
            message:
                f"Evaluating policies of {s.name}: {group}"
            shell:
                "{sys.executable:q} {SCRIPTS:q}/{params.args} > {log} 2>&1"

    for axis in SWEPT_KEYS:
        for group in groups_of(s, swept_policies(s, axis)):
            name, more = runner("sweep", group)

            rule:
                name:
                    f"sweep_{axis}_{group}_{s.name}"
                input:
                    kernels=KERNELS,
                    gains=inside(s, paths.swept_gain_files(s, axis)),
                    policies=weights(s, group),
                output:
                    whole(inside(s, paths.sweep_outputs(s, axis, group))),
                log:
                    f"{folder(s)}/logs/sweep_{axis}_{group}.log",
                benchmark:
                    f"{folder(s)}/benchmarks/sweep_{axis}_{group}.tsv"
                threads: 1
                params:
                    spec=dependencies.stage_spec(
                        f"sweep_{axis}_{group}",
                        dependencies.sweep_values(s, axis, group),
                        script(name),
                    ),
                    args=arguments(name, s, *more, "--axis", axis),
                message:
                    f"Sweeping {axis} of {s.name}: {group}"
                shell:
                    "{sys.executable:q} {SCRIPTS:q}/{params.args} > {log} 2>&1"

    for group in groups_of(s, s.generalise.policies):
        name, more = runner("generalise", group)

        rule:
            name:
                f"generalise_{group}_{s.name}"
            input:
                kernels=KERNELS,
                gains=f"{folder(s)}/{paths.gain_file('schedule')}",
                policies=weights(s, group),
            output:
                whole(inside(s, paths.cell_outputs(s, group))),
            log:
                f"{folder(s)}/logs/generalise_{group}.log",
            benchmark:
                f"{folder(s)}/benchmarks/generalise_{group}.tsv"
            threads: 1
            params:
                spec=dependencies.stage_spec(
                    f"generalise_{group}",
                    dependencies.cell_values(s, group),
                    script(name),
                ),
                args=arguments(name, s, *more),
            message:
                f"Running policies of {s.name} in cells of other sizes: {group}"
            shell:
                "{sys.executable:q} {SCRIPTS:q}/{params.args} > {log} 2>&1"

    rule:
        name:
            f"bound_{s.name}"
        input:
            kernels=KERNELS,
            gains=f"{folder(s)}/{paths.gain_file('schedule')}",
            logs=[
                log
                for group in policy_groups(s)
                for log in inside(s, paths.evaluation_logs(s, group))
            ],
        output:
            ensure(f"{folder(s)}/{paths.BOUND}", non_empty=True),
        log:
            f"{folder(s)}/logs/bound.log",
        benchmark:
            f"{folder(s)}/benchmarks/bound.tsv"
        threads: 1
        params:
            spec=dependencies.stage_spec("bound", dependencies.bound_values(s), script("bound")),
            args=arguments("bound", s),
        message:
            f"Computing exact optima of {s.name}"
        shell:
            "{sys.executable:q} {SCRIPTS:q}/{params.args} > {log} 2>&1"

    rule:
        name:
            f"gain_study_{s.name}"
        input:
            kernels=KERNELS,
            gains=inside(s, paths.study_gain_files(s)),
        output:
            whole(inside(s, paths.gain_study_logs(s))),
        log:
            f"{folder(s)}/logs/gain_study.log",
        benchmark:
            f"{folder(s)}/benchmarks/gain_study.tsv"
        threads: 1
        params:
            spec=dependencies.stage_spec(
                "gain_study", dependencies.gain_study_values(s), script("gain_study")
            ),
            args=arguments("gain_study", s),
        message:
            f"Running the gain study of {s.name}"
        shell:
            "{sys.executable:q} {SCRIPTS:q}/{params.args} > {log} 2>&1"

    for axis in GAIN_SWEEPS:

        rule:
            name:
                f"gain_sweep_{axis}_{s.name}"
            input:
                kernels=KERNELS,
                gains=inside(s, paths.gain_sweep_files(s, axis)),
            output:
                whole(inside(s, paths.gain_sweep_logs(s, axis))),
            log:
                f"{folder(s)}/logs/gain_sweep_{axis}.log",
            benchmark:
                f"{folder(s)}/benchmarks/gain_sweep_{axis}.tsv"
            threads: 1
            params:
                spec=dependencies.stage_spec(
                    f"gain_sweep_{axis}",
                    dependencies.gain_sweep_values(s, axis),
                    script("gain_sweep"),
                ),
                args=arguments("gain_sweep", s, "--axis", axis),
            message:
                f"Running the gain study of {s.name} along {axis}"
            shell:
                "{sys.executable:q} {SCRIPTS:q}/{params.args} > {log} 2>&1"
