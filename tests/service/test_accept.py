"""Asking for a job: once, at once where it was done before, with patience, with limits, and for another try."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest

from service.jobs import FINISHED, REPEATABLE, State
from service.parts import Service
from tests.service.running import InProcess, box_spec
from tests.service.test_http import add_box, finished, problem, submit


def test_what_is_only_validated_is_not_queued(http: InProcess) -> None:
    scene = add_box(http)
    answer = http.post("/v1/bakes?validate_only=true", json={"scene": scene, "spec": box_spec(), "limits": {"samples": 4}})
    assert answer.status_code == 200, answer.text
    told = answer.json()
    assert told["valid"] is True and told["probes"] == 8 and told["volumes"][0]["counts"] == [2, 2, 2]
    assert told["spec"]["stop"]["max_samples"] == 4 and told["spec"]["resolution"]["irradiance"] == 8
    bad = {"volumes": [{"fit": "node", "node": "Lamp", "counts": [1, 1, 1]}]}
    problem(http.post("/v1/bakes?validate_only=true", json={"scene": scene, "spec": bad}), 422, "spec.unknown_node")
    problem(http.post("/v1/bakes?validate=1", json={"scene": scene, "spec": box_spec()}), 422, "request.unknown_key")
    assert http.get("/v1/bakes").json()["items"] == []


@pytest.mark.parametrize(
    ("limits", "stop"),
    [
        ({"seconds": 5, "samples": 4}, {"target_error": None, "max_seconds": 5.0, "max_samples": 4}),
        ({"samples": 64}, {"target_error": None, "max_seconds": None, "max_samples": 16}),
        ({"memory_bytes": 10**9}, {"target_error": None, "max_seconds": None, "max_samples": 16}),
    ],
)
def test_limits_narrow_a_spec_and_never_widen_it(http: InProcess, limits: dict[str, Any], stop: dict[str, Any]) -> None:
    bake = submit(http, limits=limits)
    assert bake["spec"]["stop"] == stop
    assert bake["limits"] == {"memory_bytes": limits.get("memory_bytes")}


@pytest.mark.parametrize("limits", [{"seconds": 0}, {"samples": 0}, {"memory_bytes": 0}, {"rays": 1}])
def test_limits_that_cannot_be(http: InProcess, limits: dict[str, Any]) -> None:
    answer = http.post("/v1/bakes", json={"scene": add_box(http), "spec": box_spec(), "limits": limits})
    assert (
        problem(answer, 422, "request.unknown_key" if "rays" in limits else "request.invalid")["where"]
        == f"body.limits.{next(iter(limits))}"
    )


# Idempotency-Key


def test_a_key_s_request_is_done_once(http: InProcess) -> None:
    body = {"scene": add_box(http), "spec": box_spec()}
    key = {"idempotency-key": "ci-run-7"}
    first = http.post("/v1/bakes", json=body, headers=key)
    again = http.post("/v1/bakes", json=body, headers=key)
    assert (first.status_code, again.status_code) == (202, 202)
    assert first.json()["id"] == again.json()["id"] and first.headers["location"] == again.headers["location"]
    assert len(http.get("/v1/bakes").json()["items"]) == 1
    other = http.post("/v1/bakes", json={**body, "priority": 1}, headers=key)
    assert problem(other, 422, "request.key_reused")["where"] == "Idempotency-Key"
    assert http.post("/v1/bakes", json=body, headers={"idempotency-key": "ci-run-8"}).json()["id"] != first.json()["id"]
    for bad in ("", "a b", "x" * 256):
        problem(http.post("/v1/bakes", json=body, headers={"idempotency-key": bad}), 400, "request.invalid")


def test_many_at_once_with_one_key_make_one_job(http: InProcess) -> None:
    body = {"scene": add_box(http), "spec": box_spec()}
    answers: list[Any] = []

    def ask() -> None:
        answers.append(http.post("/v1/bakes", json=body, headers={"idempotency-key": "k"}))

    threads = [threading.Thread(target=ask) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    made = {a.json()["id"] for a in answers if a.status_code == 202}
    assert len(made) == 1 and len(http.get("/v1/bakes").json()["items"]) == 1
    for answer in answers:
        if answer.status_code != 202:
            problem(answer, 409, "request.key_in_flight")


def test_a_key_in_flight_is_409_and_one_of_a_request_that_failed_is_free(http: InProcess, service: Service) -> None:
    body = {"scene": add_box(http), "spec": box_spec()}
    problem(http.post("/v1/bakes", json={**body, "scene": "sha256:" + "0" * 64}, headers={"idempotency-key": "k"}), 422, "scene.unknown")
    assert http.post("/v1/bakes", json=body, headers={"idempotency-key": "k"}).status_code == 202

    add_job = service.store.add_job
    begun, go = threading.Event(), threading.Event()

    def slowly(*arguments: Any, **more: Any) -> Any:
        begun.set()
        assert go.wait(10)
        return add_job(*arguments, **more)

    service.store.add_job = slowly  # type: ignore[method-assign]
    first: list[Any] = []
    thread = threading.Thread(target=lambda: first.append(http.post("/v1/bakes", json=body, headers={"idempotency-key": "slow"})))
    thread.start()
    assert begun.wait(10)
    waiting = http.post("/v1/bakes", json=body, headers={"idempotency-key": "slow"})
    problem(waiting, 409, "request.key_in_flight")
    assert "retry-after" in waiting.headers
    problem(http.post("/v1/bakes", json={**body, "priority": 2}, headers={"idempotency-key": "slow"}), 422, "request.key_reused")
    go.set()
    thread.join()
    assert first[0].status_code == 202


def test_a_key_whose_service_died_is_free_after_the_restart(service: Service) -> None:
    assert service.store.take_key("-", "k", "digest") == ("", None)
    assert service.store.take_key("-", "k", "digest") == ("digest", None)
    service.store.reconcile()
    assert service.store.take_key("-", "k", "digest") == ("", None)


# The same again


def test_the_same_scene_and_spec_answer_from_the_finished_bundle(http: InProcess, service: Service) -> None:
    scene = add_box(http)
    body = {"scene": scene, "spec": box_spec()}
    first = http.post("/v1/bakes", json=body)
    assert "cache-status" not in first.headers
    running = http.post("/v1/bakes", json=body)
    assert running.json()["id"] != first.json()["id"], "nothing has finished yet"
    http.post(f"/v1/bakes/{running.json()['id']}:cancel")
    finished(service, first.json()["id"])

    # Defaults that are spelled out, labels and priority make no other bundle.
    spelled = {**body, "spec": {**box_spec(), "seed": 0}, "labels": {"a": "b"}, "priority": 9}
    hit = http.post("/v1/bakes", json=spelled, headers={"idempotency-key": "hit"})
    assert (hit.status_code, hit.headers["cache-status"], hit.json()["id"]) == (200, "octobake; hit", first.json()["id"])
    assert hit.headers["location"] == first.headers["location"] and "retry-after" not in hit.headers
    assert http.post("/v1/bakes", json=spelled, headers={"idempotency-key": "hit"}).json()["id"] == first.json()["id"]

    forced = http.post("/v1/bakes", json=body, headers={"cache-control": "no-cache"})
    assert (forced.status_code, "cache-status" in forced.headers) == (202, False)
    assert http.post("/v1/bakes", json={**body, "spec": {**box_spec(), "seed": 1}}).status_code == 202


def test_what_was_told_to_stop_answers_nobody_else(http: InProcess, service: Service) -> None:
    job = submit(http)["id"]
    service.store.claim()
    service.store.move(job, State.RUNNING)
    service.store.move(job, State.FINALIZING)
    service.store.move(job, State.SUCCEEDED, result={"bundle": "x", "report": "x", "stopped": "interrupt", "exit_code": 4})
    assert http.post("/v1/bakes", json={"scene": add_box(http), "spec": box_spec()}).status_code == 202


# Prefer: wait


def test_a_client_that_waits_is_answered_at_the_end(http: InProcess, service: Service) -> None:
    job = submit(http)["id"]
    began = time.monotonic()
    patient = http.get(f"/v1/bakes/{job}", headers={"prefer": "respond-async, wait=1"})
    assert 0.9 < time.monotonic() - began < 5
    assert (patient.json()["state"], patient.headers["preference-applied"], "retry-after" in patient.headers) == ("queued", "wait=1", True)
    assert "preference-applied" not in http.get(f"/v1/bakes/{job}", headers={"prefer": "wait=soon"}).headers

    def finish() -> None:
        time.sleep(0.3)
        finished(service, job)
        service.hub.tell(job)

    thread = threading.Thread(target=finish)
    thread.start()
    began = time.monotonic()
    done = http.get(f"/v1/bakes/{job}", headers={"prefer": "wait=30"})
    thread.join()
    assert time.monotonic() - began < 5
    assert (done.json()["state"], "retry-after" in done.headers) == ("succeeded", False)

    began = time.monotonic()
    waited = http.post("/v1/bakes", json={"scene": add_box(http), "spec": box_spec(4)}, headers={"prefer": "wait=1"})
    assert (waited.status_code, waited.headers["preference-applied"]) == (202, "wait=1")
    assert time.monotonic() - began > 0.9


# Requeue, pin, log, attempts


def test_another_try_begins_anew_and_keeps_what_was_tried(http: InProcess, service: Service) -> None:
    job = submit(http)["id"]
    problem(http.post(f"/v1/bakes/{job}:requeue"), 409, "job.illegal_transition")
    service.store.claim()
    service.store.add_attempt(job, "trace: KilledWorker")
    service.store.begin_pass(job, 0, 0, 16, 2)
    error = {"slug": "bake.crashed", "where": f"job {job}", "message": "its worker died", "exit_code": 3}
    service.store.move(job, State.FAILED, error=error)
    again = http.post(f"/v1/bakes/{job}:requeue")
    assert again.status_code == 200, again.text
    document = again.json()
    assert (document["state"], document["error"], document["started"], document["finished"]) == ("queued", None, None, None)
    assert [(a["number"], a["outcome"], a["reason"]) for a in document["history"]] == [
        (1, "lost", "trace: KilledWorker"),
        (2, "failed", "bake.crashed"),
    ]
    assert service.store.passes(job) == []
    finished(service, job)
    document = http.get(f"/v1/bakes/{job}").json()
    assert [a["outcome"] for a in document["history"]] == ["lost", "failed", "succeeded"] and document["attempts"] == 1
    problem(http.post(f"/v1/bakes/{job}:requeue"), 409, "job.illegal_transition")

    # Who listens from the beginning hears of both ends, and the stream ends at the last.
    stream = http.get(f"/v1/bakes/{job}/events").text
    assert stream.index('"state": "failed"') < stream.index('"state": "succeeded"')
    log = http.get(f"/v1/bakes/{job}/log")
    assert log.headers["content-type"].startswith("text/plain")
    lines = log.text.splitlines()
    assert [line.split()[1] for line in lines] == ["state", "state", "retry", "state", "state", "state", "state", "state", "state"]
    assert lines[2].endswith("trace: KilledWorker") and "[bake.crashed]" in lines[3] and "stopped=samples" in lines[-1]
    problem(http.get("/v1/bakes/none/log"), 404, "bake.unknown")


@pytest.mark.parametrize("state", sorted(REPEATABLE))
def test_what_may_be_repeated(http: InProcess, service: Service, state: State) -> None:
    assert REPEATABLE < FINISHED
    job = submit(http)["id"]
    http.post(f"/v1/bakes/{job}:cancel")
    if state == State.EXPIRED:
        assert service.store.expire(job)
    elif state == State.FAILED:
        service.store.requeue(job, ())
        service.store.claim()
        service.store.move(job, State.FAILED, error={"slug": "x", "where": "", "message": "", "exit_code": 3})
    assert http.post(f"/v1/bakes/{job}:requeue").json()["state"] == "queued"


def test_a_stop_needs_a_running_bake_with_a_whole_pass(http: InProcess, service: Service) -> None:
    job = submit(http)["id"]
    problem(http.post("/v1/bakes/none:stop"), 404, "bake.unknown")
    problem(http.post(f"/v1/bakes/{job}:stop"), 409, "job.not_running")
    service.store.claim()
    service.store.move(job, State.RUNNING)
    waiting = http.post(f"/v1/bakes/{job}:stop")
    problem(waiting, 409, "job.no_pass")
    assert "retry-after" in waiting.headers
    http.post(f"/v1/bakes/{job}:cancel")
    problem(http.post(f"/v1/bakes/{job}:stop"), 409, "job.not_running")


def test_what_is_not_there_yet(http: InProcess, service: Service) -> None:
    job = submit(http)["id"]
    for what in ("plan", "preview"):
        problem(http.get(f"/v1/bakes/{job}/{what}"), 409, "job.not_finished")
        problem(http.get(f"/v1/bakes/none/{what}"), 404, "bake.unknown")
