"""What a link may be called."""

from __future__ import annotations

import pytest

from pointlink.profiles import ADSL, LAN, NONE, parse_profile


def test_the_contract_names() -> None:
    assert parse_profile("none") is NONE
    assert parse_profile("ADSL") is ADSL
    assert parse_profile("lan") is LAN
    assert (ADSL.down_rate, ADSL.up_rate, ADSL.rtt) == (1.25e6, 256e3, 0.05)
    assert (LAN.down_rate, LAN.up_rate, LAN.rtt) == (100e6, 100e6, 0.001)


@pytest.mark.parametrize(
    ("text", "rate", "rtt"),
    [
        ("1.25M", 1.25e6, 0.05),
        ("800k,120ms", 800e3, 0.12),
        ("2G,0.05", 2e9, 0.05),
        ("56000, 0.2s", 56e3, 0.2),
        ("1m,0", 1e6, 0.0),
        (".5M,1s", 5e5, 1.0),
    ],
)
def test_rates_and_round_trips(text: str, rate: float, rtt: float) -> None:
    profile = parse_profile(text)
    assert profile.down_rate == profile.up_rate == pytest.approx(rate)
    assert profile.rtt == pytest.approx(rtt)
    assert profile.queue >= max(32 * 1024, rate / 8 * rtt)


@pytest.mark.parametrize(
    "text",
    ["", ",", "fast", "0", "0M", "-1M", "1M,", "1M,-5ms", "1M,5ms,6", "1M,61", "nan", "inf", "1e6", "2000G", "1T"],
)
def test_what_is_no_link_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(ValueError, match="for example") as refused:
        parse_profile(text)
    assert "\n" not in str(refused.value)


def test_a_profile_says_itself() -> None:
    assert str(ADSL) == "1.25 Mbit/s down, 256 kbit/s up, 50 ms"
    assert str(NONE) == "no limit down, no limit up, 0 ms"
