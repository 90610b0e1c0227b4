import pytest
import torch

from ebarf_ns.photometry.event_loss import reported_change
from ebarf_ns.photometry.sensor_response import Response, SensorResponse

TRUE = Response(0.3, 0.2, 0.5)


def reported(events: tuple[torch.Tensor, ...], sensor: Response) -> torch.Tensor:
    polarity_sum, event_count, duration_us = events
    return reported_change(
        polarity_sum, event_count, sensor.threshold_on, sensor.threshold_off, 1e-6 * sensor.leak_hz * duration_us
    )


def learn(sensor: SensorResponse, events: tuple[torch.Tensor, ...], change: torch.Tensor, rate: float) -> Response:
    optimizer = torch.optim.Adam(sensor.parameters(), lr=rate)
    for _ in range(600):
        optimizer.zero_grad()
        (reported(events, sensor()) - change).square().mean().backward()
        optimizer.step()
    return Response(*(float(number) for number in sensor()))


def test_finds_the_ratio_and_the_leak_of_a_sensor_in_the_changes_that_it_reports():
    random = torch.Generator().manual_seed(0)
    brighter, darker = torch.randint(0, 10, (2, 1000), generator=random).double()
    events = brighter - darker, brighter + darker, torch.randint(0, 1_000_000, (1000,), generator=random)
    found = learn(SensorResponse(0.245, 0.245), events, reported(events, TRUE), 1e-2)
    assert found == pytest.approx(TRUE, rel=0.02)


def test_no_events_are_explained_away():
    ones = torch.ones(50, dtype=torch.float64)
    found = learn(SensorResponse(0.3, 0.2), (9 * ones, 9 * ones, 1e6 * ones), 0 * ones, 0.1)
    assert found.threshold_on > 0.3 / 3**0.5 / 1.001 and found.leak_hz <= 1


def test_not_learned_it_is_as_given():
    sensor = SensorResponse(0.3, 0.2, learned=False)
    assert not list(sensor.parameters()) and sensor() == (0.3, 0.2, 0)
    assert [float(number) for number in SensorResponse(0.3, 0.2)()] == pytest.approx([0.3, 0.2, 0])
