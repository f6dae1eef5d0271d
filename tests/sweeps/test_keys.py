"""What a function computes with, as a hash: changes with all that it captures, and with nothing else."""

import functools
import io
import subprocess
import sys
import textwrap
import threading

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.sweeps.keys import hash_of

FACTOR = 2.0


def helper(x):
    return FACTOR * x


def caller(x):
    return helper(x) + 1.0


def capturing(thing):
    return lambda x: (thing, x)


def test_a_global_of_a_function_that_is_called_counts(monkeypatch):
    before = hash_of("fn", caller)
    assert hash_of("fn", caller) == before
    monkeypatch.setitem(globals(), "FACTOR", 3.0)
    assert hash_of("fn", caller) != before


def test_where_code_stands_does_not_count_what_it_does_counts():
    def compiled(text):
        names = {}
        exec(textwrap.dedent(text), names)
        return names["f"]

    one = compiled("def f(x):\n    return x + 1")
    assert hash_of("fn", one) == hash_of("fn", compiled("\n\n\ndef f(x):\n    return x + 1"))
    assert hash_of("fn", one) != hash_of("fn", compiled("def f(x):\n    return x + 2"))
    assert hash_of("fn", one) != hash_of("fn", compiled("def f(x):\n    return x - 1"))
    assert hash_of("fn", one) != hash_of("fn", compiled("def f(x, y=1):\n    return x + 1"))


@pytest.mark.parametrize(
    ("thing", "other"),
    [
        (1, 2),
        (1, 1.0),
        (np.arange(3.0), np.arange(3.0) + 1e-300),
        (jnp.arange(3.0), jnp.arange(3.0).at[1].add(1e-12)),
        (jnp.zeros((2, 3)), jnp.zeros((3, 2))),
        (op.HardOverclosure(), op.LinearOverclosure(stiffness=1.0)),
        (op.LinearOverclosure(stiffness=2.0), op.LinearOverclosure(stiffness=1.0)),
        (op.Newton(), op.Newton(rtol=1e-8)),
        ({"a": 1}, {"b": 1}),
        ([1, 2], (1, 2)),
        (jax.random.key(0), jax.random.key(1)),
        (functools.partial(helper, 1), functools.partial(helper, 2)),
        (jax.jit(helper), jax.jit(caller)),
        (eqx.filter_jit(helper), eqx.filter_jit(caller)),
        (jnp.sin, jnp.cos),
        (np.sin, np.cos),
    ],
)
def test_what_is_captured_counts(thing, other):
    assert hash_of("fn", capturing(thing)) == hash_of("fn", capturing(thing))
    assert hash_of("fn", capturing(thing)) != hash_of("fn", capturing(other))


def test_equal_content_counts_as_equal():
    first, second = np.arange(3.0), np.arange(3.0)
    assert hash_of("fn", capturing((first, first))) == hash_of("fn", capturing((first, second)))


def test_functions_may_call_each_other():
    def even(n):
        return n == 0 or odd(n - 1)

    def odd(n):
        return n != 0 and even(n - 1)

    assert hash_of("fn", even) == hash_of("fn", even)


@pytest.mark.parametrize("thing", [np.random.default_rng(0), threading.Lock(), io.StringIO(), object(), iter([1])])
def test_what_has_no_known_content_is_refused(thing):
    with pytest.raises(ValueError, match=r"thing is a .*cannot hash.*sweep without out="):
        hash_of("fn", capturing(thing))


def test_every_process_finds_the_same():
    code = """
        import jax.numpy as jnp, opfem as op
        from opfem.sweeps.keys import hash_of
        layer = op.Layer(0.5, op.NeoHooke(c10=1e-3, bulk=0.1))
        def fn(x, kinds=frozenset({"one", "two", "three"})):
            return layer.thickness * x, {"a", "b", "c", "d"} , jnp.sin(x), op.solve
        print(hash_of("fn", fn))
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    answers = {subprocess.run(command, capture_output=True, text=True, check=True).stdout for _ in range(2)}
    assert len(answers) == 1


def test_wrappers_count_as_what_they_wrap():
    wrapped = op.value_and_sensitivities(helper)
    assert hash_of("fn", wrapped) == hash_of("fn", op.value_and_sensitivities(helper))
    assert hash_of("fn", wrapped) != hash_of("fn", op.value_and_sensitivities(caller))
    assert hash_of("fn", wrapped) != hash_of("fn", helper)
