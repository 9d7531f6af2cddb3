"""Files in an extracted SSP archive, and their XML."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import unquote, urlsplit
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from fmuid.core.errors import FmuError

SSD = "{http://ssp-standard.org/SSP1/SystemStructureDescription}"
SSC = "{http://ssp-standard.org/SSP1/SystemStructureCommon}"
SSV = "{http://ssp-standard.org/SSP1/SystemStructureParameterValues}"
SSM = "{http://ssp-standard.org/SSP1/SystemStructureParameterMapping}"


def inside(path: Path, folder: Path, source: str | None, what: str) -> Path:
    """Return the file in the extracted archive at a relative URI.

    Raises
    ------
    FmuError
        The URI is missing, absolute or leads out of the archive, or the file does not exist.
    """
    if not source:
        raise FmuError(f"{what} has no source", where=path, fix="pack its file into resources/")
    parts = urlsplit(source)
    file = (folder / unquote(parts.path)).resolve()
    if parts.scheme or parts.netloc or parts.fragment or not file.is_relative_to(folder):
        raise FmuError(
            f"{what} has the source '{source}', which is not a file of the archive",
            where=path,
            fix="pack the file into resources/ and name it by that path",
        )
    if not file.is_file():
        raise FmuError(f"{what} has the source '{source}', which is missing", where=path, fix="pack the file")
    return file


def parse(path: Path, file: Path, name: str) -> Element:
    """Return the root of an XML file of the archive; errors call it `name`.

    Raises
    ------
    FmuError
        The file is missing or is not XML.
    """
    try:
        return ElementTree.parse(file).getroot()
    except OSError:
        raise FmuError(
            f"has no {name}",
            where=path,
            fix="it may not be an SSP file, or its content may be packed in a subfolder",
        ) from None
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise FmuError(f"{name} is not XML ({error})", where=path, fix="export it again") from None


def number(element: Element, attribute: str, path: Path, default: float = 0.0) -> float:
    """Return a numeric attribute.

    Raises
    ------
    FmuError
        It is not a number.
    """
    text = element.get(attribute)
    try:
        return default if text is None else float(text)
    except ValueError:
        kind = element.tag.rpartition("}")[2]
        raise FmuError(f"'{attribute}' of a {kind} is '{text}'", where=path, fix="write a number") from None
