// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "CoreMinimal.h"
#include "Subsystems/WorldSubsystem.h"

#include "CaviarWorldSubsystem.generated.h"

class FCaviarBridge;

/**
 * Takes part in a CAVIAR run with the level that is played.
 *
 * Start the game with `-caviar=tcp://127.0.0.1:5555 -caviarname=world`. Actors with the tag `caviar` are objects; a
 * second tag is their class (`car`, `uav`, `pedestrian`). Static mesh actors with the tag `caviar.scenery` are the
 * static scenery; a second tag is their material of Recommendation ITU-R P.2040, `concrete` without one.
 *
 * The engine and the run go in lockstep: the game is paused until a frame is granted, then goes one step of exactly
 * the granted time, and its poses answer the grant. The game loop itself never waits.
 */
UCLASS()
class CAVIARWORLD_API UCaviarWorldSubsystem : public UTickableWorldSubsystem
{
	GENERATED_BODY()

public:
	virtual bool DoesSupportWorldType(const EWorldType::Type WorldType) const override;
	virtual void OnWorldBeginPlay(UWorld& InWorld) override;
	virtual void Deinitialize() override;
	virtual void Tick(float DeltaTime) override;
	virtual TStatId GetStatId() const override;
	virtual bool IsTickableWhenPaused() const override { return true; }

private:
	// A shared pointer, whose deleter knows the type: this header need not.
	TSharedPtr<FCaviarBridge> Bridge;
};
