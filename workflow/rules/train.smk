# Training: all seeds side by side in one job. Its progress also goes to the terminal.

for s in SCENARIOS:

    rule:
        name:
            f"train_{s.name}"
        input:
            kernels=KERNELS,
            gains=f"{folder(s)}/{paths.gain_file('schedule')}",
        output:
            policies=whole(inside(s, paths.policy_files(s))),
            logs=whole(inside(s, paths.training_logs(s))),
            progress=ensure(f"{folder(s)}/{paths.PROGRESS}", non_empty=True),
        log:
            f"{folder(s)}/logs/train.log",
        benchmark:
            f"{folder(s)}/benchmarks/train.tsv"
        priority: 50  # most others wait for it
        threads: 1
        params:
            spec=spec.stage_spec("train", spec.train_values(s), script("train")),
            args=arguments("train", s),
        message:
            f"Training all seeds of {s.name}"
        shell:
            "{sys.executable} -u {params.args} 2>&1 | tee {log}"
