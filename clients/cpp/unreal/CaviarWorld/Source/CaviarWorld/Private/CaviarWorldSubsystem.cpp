// SPDX-License-Identifier: Apache-2.0
#include "CaviarWorldSubsystem.h"

#include "Components/PrimitiveComponent.h"
#include "Components/StaticMeshComponent.h"
#include "Engine/StaticMesh.h"
#include "Engine/StaticMeshActor.h"
#include "EngineUtils.h"
#include "Kismet/GameplayStatics.h"
#include "Misc/App.h"
#include "Misc/CommandLine.h"
#include "Misc/Parse.h"
#include "StaticMeshResources.h"

THIRD_PARTY_INCLUDES_START
#include "caviar.hpp"
THIRD_PARTY_INCLUDES_END

DEFINE_LOG_CATEGORY_STATIC(LogCaviar, Log, All);

namespace
{
std::string Utf8(const FString& Text) { return TCHAR_TO_UTF8(*Text); }
caviar::Vector3 Numbers(const FVector& V) { return {V.X, V.Y, V.Z}; }

// The tag behind `caviar` or `caviar.scenery`, which says a class or a material.
std::string TagBehind(const AActor& Actor, const TCHAR* Otherwise)
{
	return Utf8(Actor.Tags.Num() > 1 ? Actor.Tags[1].ToString() : FString(Otherwise));
}

// What the run calls an actor. Names of the level are the same in each start, those of spawned actors need not be.
std::string NameOf(const AActor& Actor) { return "ue." + Utf8(Actor.GetName()); }
} // namespace

// The level as a world. `step` only asks for time: the engine advances in its next tick, then `Publish` answers.
class FCaviarBridge : public caviar::World
{
public:
	explicit FCaviarBridge(UWorld& InWorld) : Level(InWorld) {}

	// Time [s] that the engine has to advance before it answers; none: no frame is granted.
	std::optional<double> Due;

	std::vector<caviar::Object> Objects() const
	{
		std::vector<caviar::Object> Found;
		for (TActorIterator<AActor> It(&Level); It; ++It)
		{
			if (It->Tags.Num() > 0 && It->Tags[0] == TEXT("caviar")) Found.push_back(ObjectOf(**It));
		}
		// The order decides who carries a device: by name, which does not change from start to start.
		std::sort(Found.begin(), Found.end(), [](const auto& A, const auto& B) { return A.name < B.name; });
		return Found;
	}

private:
	void prepare() override
	{
		claim("ue.");
		std::vector<caviar::Surface> Surfaces;
		std::map<std::string, caviar::Material> Materials;
		for (TActorIterator<AStaticMeshActor> It(&Level); It; ++It)
		{
			if (It->Tags.Num() == 0 || It->Tags[0] != TEXT("caviar.scenery")) continue;
			const std::string Type = TagBehind(**It, TEXT("concrete"));
			Materials[Type] = {Type, Type, 0.2};
			Surfaces.push_back({Utf8(It->GetName()), Type, MeshOf(*It->GetStaticMeshComponent())});
		}
		std::vector<caviar::Material> List;
		for (const auto& Entry : Materials) List.push_back(Entry.second);
		if (!Surfaces.empty()) offer_scenery(Surfaces, List);
	}

	std::vector<caviar::Object> step(double T, double Previous, const std::vector<caviar::Command>& Commands) override
	{
		// Commands with `object == NameOf(Actor)` go to that actor's controller here.
		Due = T - Previous;
		defer();
		return {};
	}

	void log(const std::string& Line) override { UE_LOG(LogCaviar, Display, TEXT("%s"), UTF8_TO_TCHAR(Line.c_str())); }

	static caviar::Object ObjectOf(const AActor& Actor)
	{
		const FTransform& Transform = Actor.GetActorTransform();
		const FBox Box = Actor.CalculateComponentsBoundingBoxInLocalSpace();
		const FQuat Turn = Transform.GetRotation();
		caviar::Pose Pose;
		Pose.position = Numbers(Transform.TransformPosition(Box.GetCenter()));
		Pose.orientation = {Turn.W, Turn.X, Turn.Y, Turn.Z};
		Pose.velocity = Numbers(Actor.GetVelocity());
		const auto* Body = Cast<UPrimitiveComponent>(Actor.GetRootComponent());
		const bool bSimulates = Body && Body->IsSimulatingPhysics();
		// Chaos states it in the engine's world axes, radians per second.
		if (bSimulates) Pose.angular_velocity = Numbers(Body->GetPhysicsAngularVelocityInRadians());
		Pose = caviar::unreal().to_enu(Pose);
		caviar::Object Object;
		Object.name = NameOf(Actor);
		Object.class_ = TagBehind(Actor, TEXT("car"));
		Object.position = Pose.position, Object.orientation = Pose.orientation, Object.velocity = Pose.velocity;
		Object.dimensions = caviar::unreal().dimensions_to_enu(Numbers(Box.GetSize() * Transform.GetScale3D()));
		if (bSimulates) Object.angular_velocity = Pose.angular_velocity;
		return Object;
	}

	// Triangles of the most detailed level, in world axes. In a packaged game the mesh needs `Allow CPU Access`.
	static caviar::Mesh MeshOf(const UStaticMeshComponent& Component)
	{
		caviar::Mesh Mesh;
		const UStaticMesh* Static = Component.GetStaticMesh();
		if (!Static || !Static->GetRenderData() || Static->GetRenderData()->LODResources.Num() == 0) return Mesh;
		const FStaticMeshLODResources& Detail = Static->GetRenderData()->LODResources[0];
		const FPositionVertexBuffer& Vertices = Detail.VertexBuffers.PositionVertexBuffer;
		for (uint32 Index = 0; Index < Vertices.GetNumVertices(); ++Index)
		{
			const FVector At = Component.GetComponentTransform().TransformPosition(FVector(Vertices.VertexPosition(Index)));
			caviar::Pose Pose;
			Pose.position = Numbers(At);
			Mesh.vertices.push_back(caviar::unreal().to_enu(Pose).position);
		}
		const FIndexArrayView Corners = Detail.IndexBuffer.GetArrayView();
		for (int32 Index = 0; Index + 2 < Corners.Num(); Index += 3)
		{
			// As seen from outside they are counter-clockwise in Unreal, as they are here.
			Mesh.triangles.push_back({int32(Corners[Index]), int32(Corners[Index + 1]), int32(Corners[Index + 2])});
		}
		return Mesh;
	}

	UWorld& Level;
};

bool UCaviarWorldSubsystem::DoesSupportWorldType(const EWorldType::Type WorldType) const
{
	return WorldType == EWorldType::Game || WorldType == EWorldType::PIE;
}

void UCaviarWorldSubsystem::OnWorldBeginPlay(UWorld& InWorld)
{
	Super::OnWorldBeginPlay(InWorld);
	FString Endpoint, Name = TEXT("world");
	if (!FParse::Value(FCommandLine::Get(), TEXT("caviar="), Endpoint)) return;
	FParse::Value(FCommandLine::Get(), TEXT("caviarname="), Name);
	Bridge = MakeShared<FCaviarBridge>(InWorld);
	if (Bridge->connect(Utf8(Endpoint), Utf8(Name))) UGameplayStatics::SetGamePaused(&InWorld, true);
	else Bridge.Reset();
}

void UCaviarWorldSubsystem::Deinitialize()
{
	if (Bridge) Bridge->leave("the level ends");
	Bridge.Reset();
	Super::Deinitialize();
}

void UCaviarWorldSubsystem::Tick(float DeltaTime)
{
	Super::Tick(DeltaTime);
	if (!Bridge) return;
	UWorld* Level = GetWorld();
	// What was granted in the tick before has been simulated by now, as long as the game ran.
	if (Bridge->Due && !UGameplayStatics::IsGamePaused(Level))
	{
		Bridge->Due.reset();
		UGameplayStatics::SetGamePaused(Level, true);
		Bridge->publish(Bridge->Objects());
	}
	if (!Bridge->poll(0))
	{
		UGameplayStatics::SetGamePaused(Level, false);
		Bridge.Reset();
		return;
	}
	if (!Bridge->Due) return;
	if (*Bridge->Due > 0.0)
	{
		FApp::SetUseFixedTimeStep(true);
		FApp::SetFixedDeltaTime(*Bridge->Due);
		UGameplayStatics::SetGamePaused(Level, false);
		return;
	}
	// Frame 0 is the state of the level as it is.
	Bridge->Due.reset();
	Bridge->publish(Bridge->Objects());
}

TStatId UCaviarWorldSubsystem::GetStatId() const
{
	RETURN_QUICK_DECLARE_CYCLE_STAT(UCaviarWorldSubsystem, STATGROUP_Tickables);
}
