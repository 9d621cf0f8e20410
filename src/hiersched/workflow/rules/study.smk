# Measures of every run, from its log or as its job took them; then each table, figure and claim by itself.
# Of these each takes seconds: on a cluster many share a job.


def shown_spec(scenario, kind, thing):
    """What a table, figure or claim depends on: the whole scenario and the code of its function."""
    values = {
        "scenario": dependencies.scenario_values(scenario, NOTES if kind == "table" else ""),
        "show": code_fingerprint(script("show")),
        "beside": dependencies.neighbours_sha256(thing),
    }
    name = thing.build.__name__
    return dependencies.stage_spec(f"{kind} {thing.name}", values, thing.file, only=name)


def shown_names(kind, thing):
    """Files of a table or a figure: the one that the report shows, and others."""
    if kind == "figure":
        return [f"figures/{thing.name}.{end}" for end in ("svg", "png")]
    ends = ("csv",) if thing.columns == () else ("html", "csv", "md")
    return [f"tables/{thing.name}.{end}" for end in ends]


def shown_caption(thing):
    """Title and note as reStructuredText: what stands between backquotes is code."""
    parts = f"{thing.title.rstrip('.')}. {thing.note}".split("`")
    return "".join(
        f"``{part}``" if place % 2 else re.sub(r"([*|_\\])", r"\\\1", part)
        for place, part in enumerate(parts)
    ).strip()


def in_report(scenario, kind, thing, name):
    """A file that the report shows under its title; a table to compute with stays out."""
    path = ensure(f"{folder(scenario)}/{name}", non_empty=True)
    if name.endswith(".csv"):
        return path
    return report(
        path,
        caption=f"../report/{kind}.rst",
        category=scenario.name,
        subcategory=f"{kind.capitalize()}s",
        labels={kind.capitalize(): textwrap.shorten(thing.title, 64, placeholder=" …")},
    )


def show_arguments(scenario, kind, thing):
    given = ("--kind", kind, "--name", thing.name, "--module", thing.module)
    return arguments("show", scenario, *given)


for s in SCENARIOS:
    for group, tables in measured_groups(s).items():

        rule:
            name:
                f"measure_{group}_{s.name}"
            input:
                kernels=KERNELS,
                runs=inside(s, measured_files(s, group)),
            output:
                whole(s, [table_file(table, group) for table in tables]),
            log:
                f"{folder(s)}/logs/measure_{group}.log",
            benchmark:
                benchmark_file(s, f"measure_{group}")
            threads: 1
            params:
                spec=spec(f"measure_{group}", dependencies.measure_values(s, group), "measure"),
                args=arguments("measure", s, "--group", group),
            message:
                f"Measuring the runs of {s.name}: {group}"
            shell:
                "{sys.executable:q} -P -m hiersched.workflow.scripts.{params.args} > {log} 2>&1"

    rule:
        name:
            f"growth_{s.name}"
        input:
            chains=inside(s, chain_files(s)),
            gains=gain_files(s, designs(s)),
        output:
            whole(s, [files.GROWTH]),
        log:
            f"{folder(s)}/logs/growth.log",
        benchmark:
            benchmark_file(s, "growth")
        priority: 10  # most tables wait for it
        threads: 1
        params:
            spec=spec("growth", dependencies.growth_values(s)),
            args=arguments("growth", s),
        message:
            f"Following the loops of {s.name} over their delays"
        shell:
            "{sys.executable:q} -P -m hiersched.workflow.scripts.{params.args} > {log} 2>&1"

    for kind, things in {"table": TABLES, "figure": FIGURES}.items():
        for thing in shown(things, s).values():
            first, *others = shown_names(kind, thing)

            rule:
                name:
                    f"{kind}_{thing.name}_{s.name}"
                input:
                    inside(s, Study.sources(s, thing.reads)),
                output:
                    in_report(s, kind, thing, first),
                    whole(s, others),
                log:
                    f"{folder(s)}/logs/{kind}_{thing.name}.log",
                group:
                    "shown"
                threads: 1
                resources:
                    runtime=10,  # [min]
                params:
                    spec=shown_spec(s, kind, thing),
                    caption=shown_caption(thing),
                    args=show_arguments(s, kind, thing),
                message:
                    f"{'Writing' if kind == 'table' else 'Drawing'} {kind} {thing.name} of {s.name}"
                shell:
                    "{sys.executable:q} -P -m hiersched.workflow.scripts.{params.args} > {log} 2>&1"

    for thing in shown(CLAIMS, s).values():

        rule:
            name:
                f"{thing.name}_{s.name}"
            input:
                inside(s, Study.sources(s, thing.reads)),
            output:
                whole(s, [f"claims/{thing.name}.json"]),
            log:
                f"{folder(s)}/logs/{thing.name}.log",
            group:
                "shown"
            threads: 1
            resources:
                runtime=10,  # [min]
            params:
                spec=shown_spec(s, "claim", thing),
                args=show_arguments(s, "claim", thing),
            message:
                f"Judging {thing.name} in {s.name}"
            shell:
                "{sys.executable:q} -P -m hiersched.workflow.scripts.{params.args} > {log} 2>&1"

    if shown(CLAIMS, s):

        rule:
            name:
                f"claims_{s.name}"
            input:
                inside(s, [f"claims/{name}.json" for name in shown(CLAIMS, s)]),
            output:
                whole(s, files.CLAIMS[:-1]),
                report(
                    ensure(f"{folder(s)}/{files.CLAIMS[-1]}", non_empty=True),
                    caption="../report/claims.rst",
                    category=s.name,
                    subcategory="Claims",
                    labels={"Claims": "Verdicts"},
                ),
            log:
                f"{folder(s)}/logs/claims.log",
            group:
                "shown"
            threads: 1
            resources:
                runtime=10,  # [min]
            params:
                spec=spec("claims", s.name),
                args=arguments("claims", s, "--names", ",".join(shown(CLAIMS, s))),
            message:
                f"Putting the claims of {s.name} together"
            shell:
                "{sys.executable:q} -P -m hiersched.workflow.scripts.{params.args} > {log} 2>&1"

    rule:
        name:
            f"page_{s.name}"
        input:
            inside(s, shown_files(s)),
            inside(s, run_files(s)),
            inside(s, source_files(s)),
        output:
            whole(s, [files.PAGE]),
        log:
            f"{folder(s)}/logs/page.log",
        threads: 1
        params:
            spec=spec("page", dependencies.scenario_values(s)),
            args=arguments("page", s, "--jobs", ",".join(JOBS[s.name])),
        message:
            f"Writing the page of {s.name}"
        shell:
            "{sys.executable:q} -P -m hiersched.workflow.scripts.{params.args} > {log} 2>&1"
