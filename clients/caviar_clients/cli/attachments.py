"""Options of `caviar run` for what installed distributions attach to a scenario: ``--NAME VALUE``."""

from __future__ import annotations

from typing import Any

from typer.core import TyperCommand, TyperOption

from caviar_protocol.plugins import plugins


class _Alias(TyperOption):
    """``--NAME VALUE``, for ``--attach NAME=VALUE``.

    Args:
        attach: The option ``--attach``, of which it is a copy.
        attachment: ``NAME``.
    """

    def __init__(self, attach: Any, attachment: str) -> None:
        vars(self).update(vars(attach))  # Typer's own arguments are not the same in all of its versions
        self.attachment, self.name, self.opts = attachment, f"attach_{attachment}", [f"--{attachment}"]
        self.metavar = "VALUE"

    @property
    def help(self) -> str:  # type: ignore[override]
        """What the attachment says of itself; its module is imported where that is shown."""
        from caviar_protocol.scenario import summary

        return summary(self.attachment)


class AttachingCommand(TyperCommand):
    """A command with ``--attach``, and an alias of it for each attachment that is installed."""

    def get_params(self, ctx: Any) -> list[Any]:
        """List the parameters, with the aliases after ``--attach``."""
        from caviar_protocol.scenario import ATTACHMENTS  # `caviar --help` loads no scenarios

        found = super().get_params(ctx)
        taken = {flag for parameter in found for flag in parameter.opts}
        at = next(i for i, parameter in enumerate(found) if parameter.name == "attach")
        names = [name for name in plugins(ATTACHMENTS) if f"--{name}" not in taken]
        return [*found[: at + 1], *(_Alias(found[at], name) for name in names), *found[at + 1 :]]

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line; the values of aliases become those of ``--attach``."""
        rest = super().parse_args(ctx, args)
        for alias in self.get_params(ctx):
            if isinstance(alias, _Alias):
                values = [f"{alias.attachment}={value}" for value in ctx.params.pop(alias.name) or ()]
                ctx.params["attach"] = [*(ctx.params["attach"] or ()), *values]
        return rest
