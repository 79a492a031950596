"""Reads, writes and monitored items with index ranges, which asyncua's server ignores. Needs asyncua."""

from __future__ import annotations

from typing import Any

from asyncua import Server, ua
from asyncua.server.address_space import AttributeService
from asyncua.server.monitored_item_service import MonitoredItemService
from asyncua.server.subscription_service import SubscriptionService

from shmio.layout.values import index_range
from shmio.model.opcua_parts import read_part, write_part


def serve_parts(server: Server) -> None:
    """Make a server, which has not started yet, heed the index ranges of requests."""
    shared: Any = server.iserver
    shared.attribute_service = _Attributes(shared.aspace)
    shared.subscription_service = _Subscriptions(shared.aspace, iserver=shared)
    shared.isession.subscription_service = shared.subscription_service


class _Attributes(AttributeService):
    def read(self, params: ua.ReadParameters) -> list[ua.DataValue]:
        found = zip(params.NodesToRead, super().read(params), strict=True)
        return [read_part(value, asked.IndexRange) if asked.IndexRange else value for asked, value in found]

    async def write(self, params: ua.WriteParameters, *given: Any, **named: Any) -> list[ua.StatusCode]:
        """Write values. A part is written over the present value of its node."""
        results: list[ua.StatusCode] = []
        for asked in params.NodesToWrite:
            if asked.IndexRange:
                present = self._aspace.read_attribute_value(asked.NodeId, asked.AttributeId)
                if present.StatusCode is not None and present.StatusCode.is_bad():
                    results.append(present.StatusCode)
                    continue
                whole = write_part(present, asked.IndexRange, asked.Value)
                if isinstance(whole, int):
                    results.append(ua.StatusCode(whole))
                    continue
                asked = ua.WriteValue(asked.NodeId, asked.AttributeId, None, whole)  # noqa: PLW2901
            results += await super().write(ua.WriteParameters([asked]), *given, **named)
        return results


class _Subscriptions(SubscriptionService):
    async def create_subscription(self, *given: Any, **named: Any) -> ua.CreateSubscriptionResult:
        result = await super().create_subscription(*given, **named)
        made = self.subscriptions[result.SubscriptionId]
        made.monitored_item_srv = _Items(made, self.aspace)
        return result


class _Items(MonitoredItemService):
    async def _create_data_change_monitored_item(
        self, params: ua.MonitoredItemCreateRequest
    ) -> ua.MonitoredItemCreateResult:
        target = params.ItemToMonitor
        if target.IndexRange:
            try:
                index_range.parse(target.IndexRange)
            except ValueError:
                return ua.MonitoredItemCreateResult(ua.StatusCode(ua.StatusCodes.BadIndexRangeInvalid))
            part = read_part(self.aspace.read_attribute_value(target.NodeId, target.AttributeId), target.IndexRange)
            if part.StatusCode is not None and part.StatusCode.value == ua.StatusCodes.BadIndexRangeNoData:
                return ua.MonitoredItemCreateResult(part.StatusCode)
        return await super()._create_data_change_monitored_item(params)

    async def datachange_callback(self, handle: int, value: ua.DataValue, error: ua.StatusCode | None = None) -> None:
        """Handle a change of a variable: report the part that the item monitors, if that has changed."""
        item = self._monitored_items.get(self._monitored_datachange.get(handle, 0))
        text = None if item is None or item.read_value_id is None else item.read_value_id.IndexRange
        await super().datachange_callback(handle, read_part(value, text) if text and not error else value, error)
