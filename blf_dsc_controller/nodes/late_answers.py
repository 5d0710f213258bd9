# SPDX-License-Identifier: Apache-2.0
"""Services whose requests are prepared in a thread and answered later.

rclpy's EventsExecutor sends at once what a callback returns, and awaits nothing.  So
the callback returns a placeholder, which is not sent but kept with the header of the
request.  Once the thread is done, `poll` calls the original callback, which finds its
work prepared, and sends the answer.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple


class _Later(NamedTuple):
    """What stands for an answer until then."""

    request: Any
    prepared: Future[None]


class _Waiting(NamedTuple):
    """A request that is being prepared, and how to answer it."""

    later: _Later
    answer: Callable[[Any, Any], Any]
    response: Any
    send: Callable[[Any], None]


class LateAnswers:
    """Requests that wait for their preparation, in the order of their arrival."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, 'preparation')
        self._waiting: deque[_Waiting] = deque()

    def delay(self, service: Any, prepare: Callable[[Any], None]) -> None:
        """Call `prepare` with each request of a Service in the thread, then answer.

        What it raises is left to the original callback, which finds the same problem.
        """
        answer = service.callback
        send = service.send_response

        def accept(request: Any, _: Any) -> _Later:
            return _Later(request, self._thread.submit(prepare, request))

        def keep(later: _Later, header: Any) -> None:
            response = service.srv_type.Response()
            waiting = _Waiting(later, answer, response, lambda each: send(each, header))
            self._waiting.append(waiting)

        service.callback = accept
        service.send_response = keep

    def poll(self) -> None:
        """Answer the requests that are prepared."""
        while self._waiting and self._waiting[0].later.prepared.done():
            later, answer, response, send = self._waiting.popleft()
            send(answer(later.request, response))
