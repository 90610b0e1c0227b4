import pytest
import torch

from ebarf_ns.photometry.event_loss import reported_change
from ebarf_ns.photometry.sensor_response import Response, SensorResponse

TRUE = Response(0.3, 0.2)


def learn(sensor: SensorResponse, events: tuple[torch.Tensor, ...], change: torch.Tensor, rate: float) -> Response:
    optimizer = torch.optim.Adam(sensor.parameters(), lr=rate)
    for _ in range(600):
        optimizer.zero_grad()
        (reported_change(*events, *sensor()) - change).square().mean().backward()
        optimizer.step()
    return Response(*(float(number) for number in sensor()))


def random_events() -> tuple[torch.Tensor, torch.Tensor]:
    brighter, darker = torch.randint(0, 10, (2, 1000), generator=torch.Generator().manual_seed(0)).double()
    return brighter - darker, brighter + darker


def test_finds_the_ratio_of_a_sensor_in_the_changes_that_it_reports():
    events = random_events()
    found = learn(SensorResponse(0.245, 0.245), events, reported_change(*events, *TRUE), 1e-2)
    assert found == pytest.approx(TRUE, rel=0.02)


def test_a_tenth_of_contrast_that_bright_places_lack_does_not_pass_for_a_ratio():
    polarity_sum, event_count = random_events()
    change = reported_change(polarity_sum, event_count, *TRUE) - 0.1 * 0.3 * polarity_sum.clamp(min=0)
    found = learn(SensorResponse(0.3, 0.2), (polarity_sum, event_count), change, 1e-3)
    assert found.threshold_on / found.threshold_off == pytest.approx(1.5, rel=0.03)


def test_no_events_are_explained_away():
    ones = torch.ones(50, dtype=torch.float64)
    found = learn(SensorResponse(0.3, 0.2), (9 * ones, 9 * ones), 0 * ones, 0.1)
    assert found.threshold_on > 0.3 / 3**0.5 / 1.001


def test_not_learned_it_is_as_given():
    sensor = SensorResponse(0.3, 0.2, learned=False)
    assert not list(sensor.parameters()) and sensor() == (0.3, 0.2)
    assert [float(number) for number in SensorResponse(0.3, 0.2)()] == pytest.approx([0.3, 0.2])
