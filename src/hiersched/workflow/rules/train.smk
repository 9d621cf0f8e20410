# Training: all seeds of a learner side by side in one job. Its progress also goes to the terminal.

for s in SCENARIOS:
    for learner in trained_learners(s):

        rule:
            name:
                f"train_{learner}_{s.name}"
            input:
                kernels=KERNELS,
                gains=gain_files(s, ["schedule"]),
            output:
                policies=whole(s, files.policy_files(s, learner)),
                logs=whole(s, files.learner_logs(s, learner)),
                progress=whole(s, [files.progress_file(learner)]),
            log:
                f"{folder(s)}/logs/train_{learner}.log",
            benchmark:
                benchmark_file(s, f"train_{learner}")
            priority: 50  # most others wait for it
            threads: 1
            params:
                spec=spec(f"train_{learner}", dependencies.train_values(s, learner), "train"),
                args=arguments("train", s, "--learner", learner),
            message:
                f"Training all seeds of {s.name}: {learner}"
            shell:
                "{sys.executable:q} -P -u -m hiersched.workflow.scripts.{params.args} 2>&1 | tee {log}"
