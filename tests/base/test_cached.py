"""The property `cached_property`: computed once, also in frozen values, and without a lock that a child waits for."""

import threading
from dataclasses import dataclass, field

from optloc.base.cached import cached_property


@dataclass(frozen=True)
class Square:
    side: float
    count: list = field(default_factory=list)

    @cached_property
    def area(self):
        """Return the area."""
        self.count.append(1)
        return self.side**2


def test_a_value_is_computed_once_for_each_object():
    one, two = Square(3.0), Square(4.0)
    assert (one.area, one.area, two.area) == (9.0, 9.0, 16.0)
    assert len(one.count) == len(two.count) == 1
    assert Square.area.__doc__ == "Return the area."


def test_a_thread_does_not_wait_for_the_value_of_another_object():
    begun, end = threading.Event(), threading.Event()

    class Slow:
        def __init__(self, waits):
            self.waits = waits

        @cached_property
        def value(self):
            if self.waits:
                begun.set()
                end.wait(20)
            return 1

    thread = threading.Thread(target=lambda: Slow(True).value)
    thread.start()
    assert begun.wait(20)
    quick = threading.Thread(target=lambda: Slow(False).value, daemon=True)
    quick.start()
    quick.join(10)
    assert not quick.is_alive()
    end.set()
    thread.join()
