"""What one submission does, in words: draw, dispatch, upload, download.

Every image stays in the layout GENERAL and every step waits for all before it: a handful of steps a picture, on a device that is the
CPU, gain nothing from finer barriers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from bake_core.vulkan.loader import vk

if TYPE_CHECKING:
    from bake_core.vulkan.pipelines import Pipeline
    from bake_core.vulkan.resources import Buffer, Image


class Draw(NamedTuple):
    """A run of vertices, drawn once for each instance of a run."""

    vertices: int
    instances: int
    first_vertex: int
    first_instance: int


class Commands:
    """Records into one command buffer; made by :meth:`Device.run`."""

    def __init__(self, handle: Any) -> None:
        self._handle = handle

    def prepare(self, image: Image) -> None:
        """Take a new image into the layout GENERAL."""
        part = vk.VkImageSubresourceRange(image.aspect, 0, 1, 0, image.layers)
        barrier = vk.VkImageMemoryBarrier2(
            srcStageMask=vk.VK_PIPELINE_STAGE_2_ALL_COMMANDS_BIT,
            dstStageMask=vk.VK_PIPELINE_STAGE_2_ALL_COMMANDS_BIT,
            dstAccessMask=vk.VK_ACCESS_2_MEMORY_READ_BIT | vk.VK_ACCESS_2_MEMORY_WRITE_BIT,
            oldLayout=vk.VK_IMAGE_LAYOUT_UNDEFINED,
            newLayout=vk.VK_IMAGE_LAYOUT_GENERAL,
            image=image.handle,
            subresourceRange=part,
        )
        vk.vkCmdPipelineBarrier2(self._handle, vk.VkDependencyInfo(pImageMemoryBarriers=[barrier]))

    def _wait(self) -> None:
        both = vk.VK_ACCESS_2_MEMORY_READ_BIT | vk.VK_ACCESS_2_MEMORY_WRITE_BIT
        every = vk.VK_PIPELINE_STAGE_2_ALL_COMMANDS_BIT
        # HOST is no command: a download is read by the host once the fence has fired.
        barrier = vk.VkMemoryBarrier2(
            srcStageMask=every, srcAccessMask=both, dstStageMask=every | vk.VK_PIPELINE_STAGE_2_HOST_BIT, dstAccessMask=both
        )
        vk.vkCmdPipelineBarrier2(self._handle, vk.VkDependencyInfo(pMemoryBarriers=[barrier]))

    def draw(
        self,
        pipeline: Pipeline,
        draws: Sequence[Draw],
        push: bytes,
        *,
        colors: Sequence[Image] = (),
        depth: Image,
        layer: int = 0,
        clear: Sequence[tuple[float, float, float, float]] = (),
    ) -> None:
        """Clear `colors` to `clear`, and layer `layer` of `depth` to 0 (far), and draw into them."""
        targets = [
            _attachment(c.layer_views[0], vk.VkClearValue(color=vk.VkClearColorValue(float32=v)))
            for c, v in zip(colors, clear, strict=True)
        ]
        far = _attachment(depth.layer_views[layer], vk.VkClearValue(depthStencil=vk.VkClearDepthStencilValue(0.0, 0)))
        area = vk.VkRect2D(vk.VkOffset2D(0, 0), vk.VkExtent2D(depth.width, depth.height))
        vk.vkCmdBeginRendering(
            self._handle, vk.VkRenderingInfo(renderArea=area, layerCount=1, pColorAttachments=targets, pDepthAttachment=far)
        )
        vk.vkCmdSetViewport(self._handle, 0, 1, [vk.VkViewport(0, 0, depth.width, depth.height, 0, 1)])
        vk.vkCmdSetScissor(self._handle, 0, 1, [area])
        self._bind(pipeline, push)
        for d in draws:
            vk.vkCmdDraw(self._handle, d.vertices, d.instances, d.first_vertex, d.first_instance)
        vk.vkCmdEndRendering(self._handle)
        self._wait()

    def dispatch(self, pipeline: Pipeline, groups: int, push: bytes) -> None:
        """Run `groups` work groups of a compute program."""
        self._bind(pipeline, push)
        vk.vkCmdDispatch(self._handle, groups, 1, 1)
        self._wait()

    def upload(self, source: Buffer, image: Image) -> None:
        """Copy packed texels into an image."""
        vk.vkCmdCopyBufferToImage(self._handle, source.handle, image.handle, vk.VK_IMAGE_LAYOUT_GENERAL, 1, [_whole(image)])
        self._wait()

    def download(self, image: Image, destination: Buffer) -> None:
        """Copy an image's texels, packed."""
        vk.vkCmdCopyImageToBuffer(self._handle, image.handle, vk.VK_IMAGE_LAYOUT_GENERAL, destination.handle, 1, [_whole(image)])
        self._wait()

    def _bind(self, pipeline: Pipeline, push: bytes) -> None:
        bindings = pipeline.bindings
        vk.vkCmdBindPipeline(self._handle, pipeline.point, pipeline.handle)
        vk.vkCmdBindDescriptorSets(self._handle, pipeline.point, bindings.layout, 0, 1, [bindings.set], 0, None)
        if push:
            data = vk.ffi.from_buffer(push)
            vk.vkCmdPushConstants(self._handle, bindings.layout, vk.VK_SHADER_STAGE_ALL, 0, len(push), data)


def _attachment(view: Any, clear: Any) -> Any:
    return vk.VkRenderingAttachmentInfo(
        imageView=view,
        imageLayout=vk.VK_IMAGE_LAYOUT_GENERAL,
        loadOp=vk.VK_ATTACHMENT_LOAD_OP_CLEAR,
        storeOp=vk.VK_ATTACHMENT_STORE_OP_STORE,
        clearValue=clear,
    )


def _whole(image: Image) -> Any:
    part = vk.VkImageSubresourceLayers(image.aspect, 0, 0, image.layers)
    return vk.VkBufferImageCopy(imageSubresource=part, imageExtent=vk.VkExtent3D(image.width, image.height, 1))
