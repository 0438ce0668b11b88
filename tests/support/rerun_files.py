"""Files of Rerun, read back."""

import pytest


def columns_of(path):
    """{place: {column: values of all rows}} of the file, its parts one behind the other."""
    reader = pytest.importorskip("rerun.chunk", reason="needs rerun-sdk").RrdReader(str(path))
    entities = {}
    for part in reader.stream().to_chunks():
        batch = part.to_record_batch()
        columns = entities.setdefault(str(part.entity_path), {})
        for name, values in zip(batch.schema.names, batch.columns, strict=True):
            columns.setdefault(name, []).extend(values.to_pylist())
    return entities
