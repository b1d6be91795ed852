"""The catalogue read as text equals the catalogue as imported."""

from gyromodel.declarations import declarations
from gyromodel.effects import CATALOGUE


def test_same_effects():
    assert set(declarations()) == set(CATALOGUE)


def test_same_declarations():
    for entry in declarations().values():
        effect = CATALOGUE[entry.id]
        assert (entry.site, entry.domain, entry.needs, entry.cause, entry.test) == (
            effect.site,
            effect.domain,
            effect.needs,
            effect.cause,
            effect.test,
        )
        imported = {
            name: (parameter.unit, parameter.typical, parameter.meaning, parameter.linear)
            for name, parameter in effect.declared().items()
        }
        assert {p.name: (p.unit, p.typical, p.meaning, p.linear) for p in entry.parameters} == imported


def test_every_entry_is_complete():
    for entry in declarations().values():
        assert entry.equation, entry.id
        assert entry.cause, entry.id
        assert entry.test, entry.id
        assert entry.site in ("gain", "scale", "rate", "output", "readout", "angle"), entry.id
        assert entry.parameters, entry.id
        assert all(parameter.meaning for parameter in entry.parameters), entry.id
