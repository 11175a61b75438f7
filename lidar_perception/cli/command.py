"""Commands, groups and choices that suggest the closest match for a misspelt word."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

import click
from click.core import ParameterSource

from lidar_perception.types import list_valid_names, suggest_name


class Choice(click.ParamType):
    """One of a fixed list of names; case is ignored, and underscores are accepted for hyphens.

    Args:
        aliases: {other accepted spelling: name}.
    """

    name = "choice"

    def __init__(self, choices: Collection[str], aliases: Mapping[str, str] = {}):
        self.choices, self.aliases = choices, aliases

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        names_by_spelling = {_normalize(alias): name for alias, name in self.aliases.items()}
        names_by_spelling |= {_normalize(name): name for name in self.choices}
        if (match := names_by_spelling.get(_normalize(str(value)))) is not None:
            return match
        self.fail(f"unknown value {value!r}{list_valid_names(str(value), self.choices)}", param, ctx)

    def get_metavar(self, param: Any, ctx: Any = None) -> str:
        return f"[{'|'.join(self.choices)}]"

    def shell_complete(self, ctx: Any, param: Any, incomplete: str) -> list[Any]:
        from click.shell_completion import CompletionItem

        return [CompletionItem(name) for name in self.choices if name.startswith(incomplete)]


def _normalize(name: str) -> str:
    return name.strip().lower().replace("_", "-")


def refuse_options(names: Iterable[str], reason: str) -> None:
    """Raise UsageError if one of these parameters of the current command was given.

    Args:
        reason: end of the message, such as "requires --weights".
    """
    context = click.get_current_context()
    for param in context.command.params:
        if param.name in names and context.get_parameter_source(param.name) not in (None, ParameterSource.DEFAULT):
            raise click.UsageError(f"{param.opts[0]} {reason}")


class Command(click.Command):
    """A command that suggests the closest match for a misspelt option."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        for param in self.params:
            if isinstance(param, OptionWithHelp) and param.is_help_requested(args):
                ctx.resilient_parsing = True  # allows required options to be missing
                super().parse_args(ctx, [*args])
                click.echo(param.list_values(ctx.params))
                ctx.exit()
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            flags = [
                flag
                for param in self.get_params(ctx)
                for flag in (*param.opts, *param.secondary_opts)
                if flag.startswith("-")
            ]
            suggestions = (p.suggest(error.option_name) for p in self.params if isinstance(p, OptionWithHelp))
            remedy = next(filter(None, suggestions), "") or suggest_name(error.option_name, flags)
            remedy = remedy or f"; {ctx.command_path} --help lists them"
            raise click.UsageError(f"no such option {error.option_name}{remedy}", ctx) from None


class OptionWithHelp(click.Option):
    """An option whose possible values are listed by `--NAME help`.

    Args:
        list_values: Function from the other options to the text that lists the possible values.
        suggest: Function from an unknown flag to a suggestion to use this option instead, or "".
    """

    def __init__(
        self,
        *args: Any,
        list_values: Callable[[Mapping[str, Any]], str],
        suggest: Callable[[str], str] = lambda flag: "",
        **kwargs: Any,
    ):
        super().__init__(*args, **kwargs)
        self.list_values, self.suggest = list_values, suggest

    def is_help_requested(self, args: list[str]) -> bool:
        """Return True if the command line asks for the listing."""
        return any(
            f"{flag}=help" in args or [flag, "help"] in [args[i : i + 2] for i in range(len(args))]
            for flag in self.opts
        )


class Group(click.Group):
    """A group that suggests the closest match for a misspelt command."""

    command_class = Command

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        name = args[0]
        if self.get_command(ctx, name) is None and not name.startswith("-"):
            commands = self.list_commands(ctx)
            ctx.fail(f"unknown command {name!r}{list_valid_names(name, commands)}")
        return super().resolve_command(ctx, args)
