"""Public names of `gbid.core.hdf5`, and the files that define them: the one list."""

from .file import (
    KEY as KEY,
    MADE_WITH as MADE_WITH,
    DamagedError as DamagedError,
    FileKind as FileKind,
    add_dataset as add_dataset,
    add_texts as add_texts,
    changing as changing,
    opened as opened,
    read_attribute as read_attribute,
    read_dataset as read_dataset,
    read_group as read_group,
    read_text as read_text,
    read_texts as read_texts,
    read_made_with as read_made_with,
    reading as reading,
    versions as versions,
    with_origin as with_origin,
    writing as writing,
)
from .types import (
    AS_JSON as AS_JSON,
    NOT_STORED as NOT_STORED,
    InFile as InFile,
    Stored as Stored,
    document_in as document_in,
    load as load,
    read_document as read_document,
    read_fields as read_fields,
    save as save,
    write_fields as write_fields,
)
