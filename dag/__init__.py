"""The component runtime: graph engine, processors, component kinds, module files, and the process that runs them."""

from ..datamesh import Status
from .backlog import BacklogConfig
from .component import Component, DataProcessComponent, GenericComponent
from .configuration import ConfigFile, find_config, import_class, nearest, parse_overrides
from .dag_component import DagComponent, MonotonicDagComponent
from .deadline import DeadlineConfig
from .drawing import draw_mermaid, draw_text
from .engine import GraphEngine, Run, Vertex, VertexTiming
from .flags import YamlFlags
from .garbage import frozen_heap
from .modules import load_module
from .process import Process
from .processor import In, Out, Processor, ProcessorConfig, ProcessorHarness
from .schema import ComponentSpec, FlagLoaderSpec, ModuleSpec, VertexSpec
from .svg import draw_svg
from .sync import AlignDagProcessor, Aligned, CommitDagProcessor, GetRecentDagProcessor
from .trigger import Trigger, TriggerConfig

__all__ = [
    "AlignDagProcessor",
    "Aligned",
    "BacklogConfig",
    "CommitDagProcessor",
    "Component",
    "ComponentSpec",
    "ConfigFile",
    "DagComponent",
    "DataProcessComponent",
    "DeadlineConfig",
    "FlagLoaderSpec",
    "GenericComponent",
    "GetRecentDagProcessor",
    "GraphEngine",
    "In",
    "ModuleSpec",
    "MonotonicDagComponent",
    "Out",
    "Process",
    "Processor",
    "ProcessorConfig",
    "ProcessorHarness",
    "Run",
    "Status",
    "Trigger",
    "TriggerConfig",
    "Vertex",
    "VertexSpec",
    "VertexTiming",
    "YamlFlags",
    "draw_mermaid",
    "draw_svg",
    "draw_text",
    "find_config",
    "frozen_heap",
    "import_class",
    "load_module",
    "nearest",
    "parse_overrides",
]
