# Every experiment: one job a group of policies, since imports cost more than short runs.

for s in SCENARIOS:
    for e in experiments(s).values():
        if e.stage == TASK:

            rule:
                name:
                    f"tune_{cell_of(e)}_{s.name}"
                input:
                    kernels=KERNELS,
                    gains=gain_files(s, experiment_designs(s, e)),
                output:
                    whole(s, [files.tuning_file(cell_of(e))]),
                log:
                    f"{folder(s)}/logs/tune_{cell_of(e)}.log",
                benchmark:
                    benchmark_file(s, f"tune_{cell_of(e)}")
                priority: 20  # the runs of the cell wait for it
                threads: 1
                params:
                    spec=spec(f"tune_{cell_of(e)}", dependencies.tune_values(s, e), "tune"),
                    args=arguments("tune", s, "--cell", cell_of(e)),
                message:
                    f"Choosing the knobs of {s.name}: {cell_of(e)}"
                shell:
                    "{sys.executable:q} -P -m hiersched.workflow.scripts.{params.args} > {log} 2>&1"

        for group in groups(s, e):
            stage = "run_learned" if group in s.learned else "run"
            tuned = e.stage == TASK
            stage = "run_task" if tuned else stage

            rule:
                name:
                    f"{e.name}_{group}_{s.name}"
                input:
                    kernels=KERNELS,
                    gains=gain_files(s, experiment_designs(s, e)),
                    policies=(inside(s, files.policy_files(s, group)) if group in s.learned else []),
                    knobs=(
                        inside(s, [files.tuning_file(cell_of(e))])
                        if tuned and group == CLASSICAL_GROUP
                        else []
                    ),
                output:
                    whole(s, files.group_files(s, e, group)),
                log:
                    f"{folder(s)}/logs/{e.name}_{group}.log",
                benchmark:
                    benchmark_file(s, f"{e.name}_{group}")
                threads: 1
                params:
                    spec=spec(f"{e.name}_{group}", dependencies.run_values(s, e, group), stage),
                    args=arguments(stage, s, "--experiment", e.name, "--group", group),
                message:
                    f"Running {e.name} of {s.name}: {group}"
                shell:
                    "{sys.executable:q} -P -m hiersched.workflow.scripts.{params.args} > {log} 2>&1"

    if s.bound.slots_per_log:
        evaluation = experiments(s)["evaluate"]

        rule:
            name:
                f"bound_{s.name}"
            input:
                kernels=KERNELS,
                gains=gain_files(s, ["schedule"]),
                logs=inside(s, files.group_logs(evaluation, evaluation.policies)),
            output:
                whole(s, [files.BOUND]),
            log:
                f"{folder(s)}/logs/bound.log",
            benchmark:
                benchmark_file(s, "bound")
            threads: 1
            params:
                spec=spec("bound", dependencies.bound_values(s)),
                args=arguments("bound", s),
            message:
                f"Computing exact optima of {s.name}"
            shell:
                "{sys.executable:q} -P -m hiersched.workflow.scripts.{params.args} > {log} 2>&1"
