"""Verbs that speak to the service: submit, watch, jobs, table, cancel, retry, subjects."""

from __future__ import annotations

import argparse
import itertools
import sys
from pathlib import Path
from typing import Any

from rsavatar.cli_progress import Display, print_means
from rsavatar.cli_request import read_request
from rsavatar.client import Client


def submit(arguments: argparse.Namespace) -> int:
    """``rsavatar submit``: queue a job and print its id."""
    request = read_request(arguments.spec, arguments.set)
    with Client(arguments.url) as client:
        job = client.submit(request, arguments.key, arguments.force)
        print(job["id"], flush=True)
        return _follow(client, job["id"]) if arguments.watch else 0


def watch(arguments: argparse.Namespace) -> int:
    """``rsavatar watch``: follow a job; status 1 where it does not succeed."""
    with Client(arguments.url) as client:
        return _follow(client, arguments.job_id)


def jobs(arguments: argparse.Namespace) -> int:
    """``rsavatar jobs``: a line per job, newest first."""
    filters = {k: v for k in ("state", "method", "subject", "q", "sort") if (v := getattr(arguments, k)) is not None}
    filters["limit"] = str(max(1, min(arguments.limit, 200)))
    with Client(arguments.url) as client:
        for job in itertools.islice(client.jobs(**filters), arguments.limit):
            print(_line(job))
    return 0


def table(arguments: argparse.Namespace) -> int:
    """``rsavatar table``: a table of results, as the service renders it."""
    with Client(arguments.url) as client:
        named = {name: getattr(arguments, name) for name in ("grid", "preset", "tag", "seed", "q")}
        filters = {name: value for name, value in named.items() if value}
        sys.stdout.write(client.table(arguments.name, arguments.format, **filters))
    return 0


def cancel(arguments: argparse.Namespace) -> int:
    """``rsavatar cancel``: ask a job to stop."""
    with Client(arguments.url) as client:
        print(_line(client.cancel(arguments.job_id)))
    return 0


def retry(arguments: argparse.Namespace) -> int:
    """``rsavatar retry``: queue a job again."""
    with Client(arguments.url) as client:
        print(_line(client.retry(arguments.job_id)))
    return 0


def subjects(arguments: argparse.Namespace) -> int:
    """``rsavatar subjects``: the known subjects, after adding or removing one where asked to."""
    with Client(arguments.url) as client:
        if arguments.add:
            client.register_subject(*arguments.add)
        if arguments.upload:
            client.upload_subject(arguments.upload[0], Path(arguments.upload[1]))
        if arguments.remove:
            client.remove_subject(arguments.remove)
        for subject in client.subjects():
            print(f"{subject['name']:<24} {subject['state']:<9} {subject.get('path') or 'built in'}")
            for finding in subject["info"].get("report", []):
                if finding["severity"] == "error":
                    print(f"{'':<24} {finding['what']}: expected {finding['expected']}, got {finding['got']}")
    return 0


def _follow(client: Client, job_id: str) -> int:
    with Display() as display:
        for event in client.events(job_id):
            display.show({"kind": event.kind, **event.data})
    job = client.job(job_id)
    if job["state"] != "succeeded":
        print(_line(job), file=sys.stderr)
        return 1
    results = client.results(job_id)
    print_means(f"{job['method']} on {job['subject']}", results["means"], results["protocol"])
    return 0


def _line(job: dict[str, Any]) -> str:
    look, error = job["progress"], job["error"]
    progress = f"{look['stage'] or ''} {look['step']}/{look['steps']}" if look["steps"] else ""
    words = f"{job['id']}  {job['state']:<10} {job['method']:<12} {job['subject']:<16} {progress:<22}"
    return f"{words} {error['message'] if error else ''}".rstrip()
