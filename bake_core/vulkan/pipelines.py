"""Programs and what they read: one descriptor set of buffers and textures, and some bytes of push constants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from bake_core.vulkan.loader import vk
from bake_core.vulkan.resources import Buffer, Image

if TYPE_CHECKING:
    from bake_core.vulkan.device import Device

# What every device grants; all programs share it.
PUSH_BYTES = 128


class Bindings:
    """Resources as a shader sees them: number i of `resources` is ``binding = i`` of set 0, a storage buffer or a sampler2DArray."""

    def __init__(self, device: Device, resources: Sequence[Buffer | Image]) -> None:
        kinds = [_kind(r) for r in resources]
        slots = [
            vk.VkDescriptorSetLayoutBinding(binding=i, descriptorType=kind, descriptorCount=1, stageFlags=vk.VK_SHADER_STAGE_ALL)
            for i, kind in enumerate(kinds)
        ]
        set_info = vk.VkDescriptorSetLayoutCreateInfo(pBindings=slots)
        set_layout = device.make(vk.vkCreateDescriptorSetLayout, vk.vkDestroyDescriptorSetLayout, set_info)
        push = vk.VkPushConstantRange(vk.VK_SHADER_STAGE_ALL, 0, PUSH_BYTES)
        info = vk.VkPipelineLayoutCreateInfo(pSetLayouts=[set_layout], pPushConstantRanges=[push])
        self.layout = device.make(vk.vkCreatePipelineLayout, vk.vkDestroyPipelineLayout, info)
        sizes = [vk.VkDescriptorPoolSize(kind, kinds.count(kind)) for kind in sorted(set(kinds))]
        pool_info = vk.VkDescriptorPoolCreateInfo(maxSets=1, pPoolSizes=sizes)
        pool = device.make(vk.vkCreateDescriptorPool, vk.vkDestroyDescriptorPool, pool_info)
        allocate = vk.VkDescriptorSetAllocateInfo(descriptorPool=pool, pSetLayouts=[set_layout])
        self.set = vk.vkAllocateDescriptorSets(device.handle, allocate)[0]
        infos = [_info(r) for r in resources]  # kept until the update: the writes below only point to them
        writes = [
            vk.VkWriteDescriptorSet(
                dstSet=self.set,
                dstBinding=i,
                descriptorCount=1,
                descriptorType=kind,
                pBufferInfo=[info] if isinstance(r, Buffer) else None,
                pImageInfo=[info] if isinstance(r, Image) else None,
            )
            for i, (r, kind, info) in enumerate(zip(resources, kinds, infos, strict=True))
        ]
        vk.vkUpdateDescriptorSets(device.handle, len(writes), writes, 0, None)


def _kind(resource: Buffer | Image) -> int:
    kind: int = vk.VK_DESCRIPTOR_TYPE_STORAGE_BUFFER if isinstance(resource, Buffer) else vk.VK_DESCRIPTOR_TYPE_COMBINED_IMAGE_SAMPLER
    return kind


def _info(resource: Buffer | Image) -> Any:
    if isinstance(resource, Buffer):
        return vk.VkDescriptorBufferInfo(resource.handle, 0, resource.size)
    return vk.VkDescriptorImageInfo(resource.sampler, resource.view, vk.VK_IMAGE_LAYOUT_GENERAL)


@dataclass(frozen=True)
class Pipeline:
    """A compiled program with its bindings."""

    handle: Any
    bindings: Bindings
    point: int


def compute_pipeline(device: Device, spirv: bytes, bindings: Bindings) -> Pipeline:
    """A compute program; its entry point is ``main``."""
    stage = _stage(device, spirv, vk.VK_SHADER_STAGE_COMPUTE_BIT)
    info = vk.VkComputePipelineCreateInfo(stage=stage, layout=bindings.layout)
    handle = vk.vkCreateComputePipelines(device.handle, None, 1, [info], None)[0]
    device.later(vk.vkDestroyPipeline, device.handle, handle, None)
    device.check()
    return Pipeline(handle, bindings, vk.VK_PIPELINE_BIND_POINT_COMPUTE)


def graphics_pipeline(device: Device, vertex: bytes, fragment: bytes | None, bindings: Bindings, targets: int) -> Pipeline:
    """A program that draws triangles into `targets` colour targets and a depth target.

    There are no vertex buffers (shaders fetch by ``gl_VertexIndex``), nothing is culled, and depth is reversed: 1 is near, the greater
    wins. Without a fragment shader only depth is written.
    """
    stages = [_stage(device, vertex, vk.VK_SHADER_STAGE_VERTEX_BIT)]
    if fragment is not None:
        stages.append(_stage(device, fragment, vk.VK_SHADER_STAGE_FRAGMENT_BIT))
    rgba = vk.VK_COLOR_COMPONENT_R_BIT | vk.VK_COLOR_COMPONENT_G_BIT | vk.VK_COLOR_COMPONENT_B_BIT | vk.VK_COLOR_COMPONENT_A_BIT
    plain = [vk.VkPipelineColorBlendAttachmentState(blendEnable=False, colorWriteMask=rgba) for _ in range(targets)]
    formats = vk.VkPipelineRenderingCreateInfo(
        colorAttachmentCount=targets,
        pColorAttachmentFormats=[vk.VK_FORMAT_R32G32B32A32_SFLOAT] * targets,
        depthAttachmentFormat=vk.VK_FORMAT_D32_SFLOAT,
    )
    info = vk.VkGraphicsPipelineCreateInfo(
        pNext=formats,
        pStages=stages,
        pVertexInputState=vk.VkPipelineVertexInputStateCreateInfo(),
        pInputAssemblyState=vk.VkPipelineInputAssemblyStateCreateInfo(topology=vk.VK_PRIMITIVE_TOPOLOGY_TRIANGLE_LIST),
        pViewportState=vk.VkPipelineViewportStateCreateInfo(viewportCount=1, scissorCount=1),
        pRasterizationState=vk.VkPipelineRasterizationStateCreateInfo(
            polygonMode=vk.VK_POLYGON_MODE_FILL,
            cullMode=vk.VK_CULL_MODE_NONE,
            frontFace=vk.VK_FRONT_FACE_COUNTER_CLOCKWISE,
            lineWidth=1.0,
        ),
        pMultisampleState=vk.VkPipelineMultisampleStateCreateInfo(rasterizationSamples=vk.VK_SAMPLE_COUNT_1_BIT),
        pDepthStencilState=vk.VkPipelineDepthStencilStateCreateInfo(
            depthTestEnable=True, depthWriteEnable=True, depthCompareOp=vk.VK_COMPARE_OP_GREATER
        ),
        pColorBlendState=vk.VkPipelineColorBlendStateCreateInfo(attachmentCount=targets, pAttachments=plain),
        pDynamicState=vk.VkPipelineDynamicStateCreateInfo(pDynamicStates=[vk.VK_DYNAMIC_STATE_VIEWPORT, vk.VK_DYNAMIC_STATE_SCISSOR]),
        layout=bindings.layout,
    )
    handle = vk.vkCreateGraphicsPipelines(device.handle, None, 1, [info], None)[0]
    device.later(vk.vkDestroyPipeline, device.handle, handle, None)
    device.check()
    return Pipeline(handle, bindings, vk.VK_PIPELINE_BIND_POINT_GRAPHICS)


def _stage(device: Device, spirv: bytes, stage: int) -> Any:
    info = vk.VkShaderModuleCreateInfo(codeSize=len(spirv), pCode=spirv)
    module = device.make(vk.vkCreateShaderModule, vk.vkDestroyShaderModule, info)
    return vk.VkPipelineShaderStageCreateInfo(stage=stage, module=module, pName="main")
