"""Requests are served in turn, whoever asks for how much."""

from __future__ import annotations

from apex_bat.replay.requests import MAX_EACH, MAX_PEERS, SampleRequests
from apex_bat.transport.messages import SampleRequest


def request(number: int) -> SampleRequest:
    return SampleRequest(number, 16, 0)


def test_who_asks_for_much_does_not_crowd_out_who_asks_for_little() -> None:
    requests = SampleRequests()
    for number in range(100):
        requests.offer(b"greedy", request(number))
    requests.offer(b"modest", request(7))
    served = [requests.take() for _ in range(3)]
    assert served == [(b"greedy", request(0)), (b"modest", request(7)), (b"greedy", request(1))]
    assert requests.peers() == {b"greedy"}
    assert len(requests) == 98


def test_a_request_that_comes_twice_waits_once() -> None:
    requests = SampleRequests()
    assert [requests.offer(b"a", request(1)) for _ in range(2)] == ["queued", "held"]
    assert requests.offer(b"b", request(1)) == "queued"
    assert requests.peek() == request(1)


def test_what_waits_is_bounded_for_each_and_in_all() -> None:
    requests = SampleRequests()
    verdicts = [requests.offer(b"a", request(number)) for number in range(MAX_EACH + 1)]
    assert verdicts == ["queued"] * MAX_EACH + ["flood"]
    verdicts = [requests.offer(b"peer%d" % number, request(0)) for number in range(MAX_PEERS)]
    assert verdicts == ["queued"] * (MAX_PEERS - 1) + ["flood"]
    while requests.peek() is not None:
        requests.take()
    assert len(requests) == 0
    assert requests.offer(b"peer", request(0)) == "queued"
