"""The command line of optloc: ``optloc fix``, ``check``, ``track`` and other commands; ``optloc --help`` lists them."""

from typing import TYPE_CHECKING

from optloc.base.faces import exported

if TYPE_CHECKING:
    from optloc.cli.application import app as app, main as main
    from optloc.cli.compile import TARGET as TARGET, problem_of as problem_of
    from optloc.cli.completion import complete as complete
    from optloc.cli.crlb import vector as vector
    from optloc.cli.extensions import (
        Extension as Extension,
        KernelPart as KernelPart,
        PictureRequest as PictureRequest,
        Rows as Rows,
    )
    from optloc.cli.listing import registry as registry
    from optloc.cli.options import (
        ANSWERS as ANSWERS,
        MORE as MORE,
        READER_GONE as READER_GONE,
        STOPPED as STOPPED,
        AmbiguityDraws as AmbiguityDraws,
        Budget as Budget,
        Choose as Choose,
        CommandGroup as CommandGroup,
        Costs as Costs,
        Criterion as Criterion,
        FailOne as FailOne,
        Force as Force,
        Height as Height,
        Json as Json,
        Method as Method,
        Outside as Outside,
        PlacementMap as PlacementMap,
        PlaceOfInterest as PlaceOfInterest,
        ProblemPath as ProblemPath,
        Quiet as Quiet,
        Verbose as Verbose,
        choice as choice,
        example as example,
        find_problem as find_problem,
        name_in as name_in,
    )
    from optloc.cli.output import (
        Screen as Screen,
        bar as bar,
        claim_outputs as claim_outputs,
        dumps as dumps,
        line as line,
        say as say,
        show_sheet as show_sheet,
        write_picture as write_picture,
        write_table as write_table,
        write_text as write_text,
    )
    from optloc.cli.track import TrackOptions as TrackOptions, dynamics_of as dynamics_of, rules as rules
    from optloc.cli.wave import TurnAround as TurnAround, TwoWay as TwoWay, WaveSpeed as WaveSpeed, Wind as Wind

if not TYPE_CHECKING:
    __getattr__, __dir__, __all__ = exported(__name__, __file__)
