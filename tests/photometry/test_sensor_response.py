import pytest
import torch

from ebarf_ns.photometry.event_loss import reported_change
from ebarf_ns.photometry.sensor_response import Response, SensorResponse, thresholds_of_ratio

TRUE = Response(0.3, 0.2)


def learn(sensor: SensorResponse, events: tuple[torch.Tensor, ...], change: torch.Tensor, prior: float) -> Response:
    optimizer = torch.optim.Adam(sensor.parameters(), lr=0.02)
    for _ in range(600):
        optimizer.zero_grad()
        loss = (reported_change(*events, *sensor()) - change).square().mean() + prior * sensor.prior()
        loss.backward()
        optimizer.step()
    return Response(*(float(number) for number in sensor()))


def random_events() -> tuple[torch.Tensor, torch.Tensor]:
    brighter, darker = torch.randint(0, 10, (2, 1000), generator=torch.Generator().manual_seed(0)).double()
    return brighter - darker, brighter + darker


def test_the_ratio_is_refined_within_its_deviation():
    events = random_events()
    found = learn(SensorResponse(0.24, 0.25, 0.3), events, reported_change(*events, *TRUE), 1e-4)
    assert found.threshold_on / found.threshold_off == pytest.approx(1.5, rel=0.03)
    assert found.threshold_on * found.threshold_off == pytest.approx(0.06)


def test_contrast_missing_in_bright_regions_is_not_mistaken_for_a_ratio():
    polarity_sum, event_count = random_events()
    change = reported_change(polarity_sum, event_count, *TRUE) - 0.1 * 0.3 * polarity_sum.clamp(min=0)
    found = learn(SensorResponse(0.3, 0.2, 0.1), (polarity_sum, event_count), change, 1e-3)
    assert found.threshold_on / found.threshold_off == pytest.approx(1.5, rel=0.05)


@pytest.mark.parametrize("deviation", [0.03, 0.1, 0.5])
def test_the_ratio_cannot_explain_events_away(deviation: float):
    ones = torch.ones(50, dtype=torch.float64)
    found = learn(SensorResponse(0.3, 0.2, deviation), (0 * ones, 18 * ones), -5 * ones, 0.0)
    least = 1.5 * torch.exp(torch.tensor(-2 * deviation))
    assert least * 0.999 <= found.threshold_on / found.threshold_off < 1.5


def test_the_prior_holds_the_ratio_against_a_weak_ramp():
    events = random_events()
    ramp = reported_change(*events, *TRUE) + 0.002
    free, held = (learn(SensorResponse(0.3, 0.2, 0.05), events, ramp, prior) for prior in (0.0, 0.1))
    off = [abs(one.threshold_on / one.threshold_off - 1.5) for one in (free, held)]
    assert off[1] < 0.2 * off[0]


def test_without_a_deviation_the_thresholds_are_fixed():
    sensor = SensorResponse(0.3, 0.2)
    assert not list(sensor.parameters()) and sensor() == (0.3, 0.2) and not sensor.learns_ratio
    assert [float(number) for number in SensorResponse(0.3, 0.2, 0.1)()] == pytest.approx([0.3, 0.2])


def test_thresholds_of_a_ratio_have_the_given_mean():
    on, off = thresholds_of_ratio(1.5, 0.25)
    assert on / off == pytest.approx(1.5) and on * off == pytest.approx(0.0625)


def test_delay_is_inversely_proportional_to_intensity():
    sensor = SensorResponse(0.25, 0.25, time_constant_us=2000.0)
    assert not list(sensor.parameters()) and sensor.delays
    intensity = torch.tensor([0.01, 0.5, 1.0, 2.0])
    mean = float(intensity.log().mean().exp())
    # Without the bound, the darkest pixel would be delayed by 32 time constants.
    expected_us = [16_000, *(2000 * mean / intensity[1:]).tolist()]
    assert sensor.delay_us(intensity.log()).tolist() == pytest.approx(expected_us)


def test_a_time_constant_is_learned_from_delayed_signals_and_stays_at_0_without_delay():
    t = torch.linspace(0, 1, 4000, dtype=torch.float64)
    signal = lambda t: torch.sin(9 * t) + 0.5 * torch.sin(31 * t + 1)  # noqa: E731
    for true_us in (0.0, 3000.0):
        sensor = SensorResponse(0.25, 0.25, time_constant_us=None).double()
        optimizer = torch.optim.Adam(sensor.parameters(), lr=0.01)
        seen = signal(t - true_us * 1e-6)
        for step in range(1600):
            sensor.begin_step(step)
            optimizer.zero_grad()
            if sensor.time_constant.requires_grad:
                loss = (signal(t - sensor.delay_us(torch.zeros_like(t)) * 1e-6) - seen).square().mean()
                loss.backward()
                optimizer.step()
        assert float(sensor.time_constant_us) == pytest.approx(true_us, abs=30)
    assert not SensorResponse(0.25, 0.25).delays
