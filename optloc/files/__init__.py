"""Problem files: stations and measurements in TOML, CSV and Parquet, in the units of the file."""

from typing import TYPE_CHECKING

from optloc.base.faces import exported

if TYPE_CHECKING:
    from optloc.base.inputs import (
        Budget as Budget,
        access as access,
        has_controls as has_controls,
        json_of as json_of,
        read_bytes as read_bytes,
        read_text as read_text,
        within as within,
    )
    from optloc.base.locked_folder import locked_folder as locked_folder, unwritable_folder as unwritable_folder
    from optloc.base.outputs import (
        GrowingFile as GrowingFile,
        claim as claim,
        is_stream as is_stream,
        make_folder as make_folder,
        replace_together as replace_together,
        visible as visible,
        write_text as write_text,
        written as written,
    )
    from optloc.files.constraint_files import StatedConstraint as StatedConstraint
    from optloc.files.constraint_reader import limits_of as limits_of
    from optloc.files.constraint_table import ConstraintTable as ConstraintTable, height_table as height_table
    from optloc.files.convert import load_table as load_table
    from optloc.files.long_table import from_table as from_table
    from optloc.files.measurements import (
        Context as Context,
        ends_of as ends_of,
        sigma_of as sigma_of,
        values_of as values_of,
        without_turn_around as without_turn_around,
    )
    from optloc.files.one_call import locate as locate
    from optloc.files.orbits import satellites as satellites
    from optloc.files.propagation import (
        NOT_STATED as NOT_STATED,
        fits_sound as fits_sound,
        is_time as is_time,
        positive_speed as positive_speed,
        speed_of as speed_of,
    )
    from optloc.files.reader import (
        Draft as Draft,
        Loaded as Loaded,
        assemble as assemble,
        draft as draft,
        load as load,
        read as read,
    )
    from optloc.files.roles import with_standard_columns as with_standard_columns
    from optloc.files.schema import (
        DataTable as DataTable,
        FrameTable as FrameTable,
        MeasurementsTable as MeasurementsTable,
        PriorTable as PriorTable,
        ProblemFile as ProblemFile,
        SoundTable as SoundTable,
        SpeedTable as SpeedTable,
        StationsTable as StationsTable,
        kind_model as kind_model,
        name_of as name_of,
        parse_toml as parse_toml,
        read_document as read_document,
        validate as validate,
        validated as validated,
    )
    from optloc.files.settings import Units as Units, join as join
    from optloc.files.stations import survey as survey
    from optloc.files.table import Table as Table, of_rows as of_rows, table_of as table_of
    from optloc.files.unknowns import FREE as FREE, places_of as places_of, settle_frame as settle_frame
    from optloc.files.wave_speed import (
        StatedSpeed as StatedSpeed,
        WaveOptions as WaveOptions,
        stated_speed as stated_speed,
        with_options as with_options,
        with_profile as with_profile,
    )
    from optloc.files.words import distinct as distinct
    from optloc.files.writer import harmless_column as harmless_column, toml_text as toml_text

if not TYPE_CHECKING:
    __getattr__, __dir__, __all__ = exported(__name__, __file__)
