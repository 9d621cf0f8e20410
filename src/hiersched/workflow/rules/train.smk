# Training: all seeds of a learner side by side in one job. Its progress also goes to the terminal.

for s in SCENARIOS:
    for learner in s.learned:

        rule:
            name:
                f"train_{learner}_{s.name}"
            input:
                kernels=KERNELS,
                gains=f"{folder(s)}/{paths.gain_file('schedule')}",
            output:
                policies=whole(inside(s, paths.policy_files(s, learner))),
                logs=whole(inside(s, paths.training_logs(s, learner))),
                checkpoints=whole(inside(s, paths.checkpoint_logs(s, learner))),
                progress=ensure(f"{folder(s)}/{paths.progress_file(learner)}", non_empty=True),
            log:
                f"{folder(s)}/logs/train_{learner}.log",
            benchmark:
                f"{folder(s)}/benchmarks/train_{learner}.tsv"
            priority: 50  # most others wait for it
            threads: 1
            params:
                spec=dependencies.stage_spec(
                    f"train_{learner}", dependencies.train_values(s, learner), script("train")
                ),
                args=arguments("train", s, "--learner", learner),
            message:
                f"Training all seeds of {s.name}: {learner}"
            shell:
                "{sys.executable:q} -u {SCRIPTS:q}/{params.args} 2>&1 | tee {log}"
